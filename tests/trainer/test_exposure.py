"""Exposure: changes of the photographs' colours are undone, and nothing else changes."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from interrupted import whole_and_resumed

from skipgs_plug import SkipGate
from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer
from skipgs_plug.trainer.exposure import Exposure, fit_colours
from skipgs_plug.trainer.metrics import chosen, measure, psnr
from skipgs_plug.trainer.synthetic import make_scene


@pytest.fixture(scope="module")
def changing() -> Scene:
    """Every other training photograph has 60 % of its light, and a tint."""
    scene = make_scene(n_views=10, width=32, height=24, n_points=160)
    dark = torch.tensor([0.6, 0.54, 0.66])
    train = [
        dataclasses.replace(view, image=(view.image * dark).round().byte()) if i % 2 else view
        for i, view in enumerate(scene.train)
    ]
    return dataclasses.replace(scene, train=train)


def test_fitted_colours_undo_any_affine_map() -> None:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(20, 30, 3, generator=generator)
    affine = torch.eye(3, 3) + 0.3 * torch.randn(3, 3, generator=generator)
    changed = (target - 0.1) @ affine
    assert psnr(changed, target) < 25
    assert torch.allclose(fit_colours(changed, target), target, atol=1e-3)
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[:10] = True
    spoilt = torch.where(mask[..., None], target, torch.ones(()))
    assert torch.allclose(fit_colours(changed, spoilt, mask), target, atol=1e-3)
    assert measure(chosen(fitted=True), changed, spoilt, mask)["cc_psnr"] > 50
    grey = torch.full((20, 30, 3), 0.5)
    assert torch.allclose(fit_colours(grey, grey), grey, atol=1e-5)
    values = measure(chosen(fitted=True), changed, target)
    assert values["cc_psnr"] > values["psnr"] + 20 and values["cc_ssim"] > 0.999 > values["ssim"]


def test_its_rate_falls_to_a_tenth_over_the_schedule(changing: Scene) -> None:
    trainer = Trainer(TrainConfig(max_steps=150, exposure=True), changing)
    rates = []
    for step in (0, 75, 150, 200):
        trainer.set_learning_rate(step)
        rates.append(trainer.exposure.optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([0.01, 0.01 * 0.1**0.5, 0.001, 0.001])


def test_changes_of_exposure_cost_less_with_it(changing: Scene) -> None:
    ends = {}
    for exposure in (False, True):
        trainer = Trainer(TrainConfig(max_steps=150, refine_stop_iter=0, exposure=exposure), changing)
        trainer.train(progress=False)
        rows = [measure(chosen(fitted=True), trainer.render(view), view.image / 255.0) for view in changing.test]
        ends[exposure] = sum(row["cc_psnr"] for row in rows) / len(rows), trainer.evaluate("train")["psnr"]
    assert ends[True][0] > ends[False][0] + 0.5 and ends[True][1] > ends[False][1] + 2.0
    affine = trainer.exposure.affine.detach()
    light = affine[:, :, :3].sum(dim=2).mean(dim=1)
    assert light[1::2].max() < light[0::2].min()
    # The mean correction is the identity, so colours cannot drift.
    assert torch.allclose(affine.mean(dim=0), torch.eye(3, 4), atol=1e-5)
    stats = trainer.evaluate()
    assert stats["cc_psnr"] > stats["psnr"] and "fitted per image" in stats["cc_psnr_flavour"]
    assert "cc_psnr" not in trainer.evaluate("train")


def test_held_out_views_and_the_model_stay_without(changing: Scene) -> None:
    trainer = Trainer(TrainConfig(max_steps=20, exposure=True), changing)
    trainer.train(progress=False)
    held_out, known = changing.test[0], changing.train[1]
    unknown = dataclasses.replace(known, name="somewhere else")
    plain, before = [trainer.render(view) for view in (held_out, unknown)], trainer.render(known)
    with torch.no_grad():
        trainer.exposure.affine.mul_(0.5)
    for view, image in zip((held_out, unknown), plain, strict=True):
        assert torch.equal(trainer.render(view), image)
    assert torch.allclose(trainer.render(known), 0.5 * before, atol=1e-6)


@pytest.mark.parametrize("settings", [{}, {"refine_share": 0.4}, None])
@pytest.mark.parametrize("stop", [13, 45])
def test_resumed_equals_uninterrupted(tmp_path: Path, changing: Scene, stop: int, settings: dict | None) -> None:
    config = TrainConfig(max_steps=60, refine_every=4, sh_degree_interval=5000, exposure=True)

    def made() -> Trainer:
        trainer = Trainer(config, changing)
        if settings is not None:
            SkipGate(trainer, **settings)
        return trainer

    whole, second = whole_and_resumed(made, stop, tmp_path / "c.pt")
    assert all(torch.equal(whole.splats[name], second.splats[name]) for name in whole.splats)
    states = [trainer.exposure.state_dict() for trainer in (whole, second)]
    assert states[0].keys() == {"affine", "step", "exp_avg", "exp_avg_sq"}
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert not torch.equal(whole.exposure.affine, Exposure(whole.view_names, torch.device("cpu")).affine)


def test_a_skipped_backward_leaves_it_alone_and_larger_steps_do_not_reach_it(changing: Scene) -> None:
    trainer = Trainer(TrainConfig(max_steps=60, exposure=True), changing)
    trainer.train(until=30, progress=False)
    rates = []
    trainer.exposure.optimizer.register_step_pre_hook(lambda *_: rates.append(rate()))

    def rate() -> float:
        return trainer.exposure.optimizer.param_groups[0]["lr"]

    with SkipGate(trainer, refine_share=0.5):
        trainer.train(until=32, progress=False)
    assert rates[0] == pytest.approx(0.25 * rate(), rel=0.05)
    before = trainer.exposure.affine.detach().clone()
    trainer.backward = lambda loss, view, step: None  # stands for a gate that skips
    trainer.train(until=40, progress=False)
    assert torch.equal(trainer.exposure.affine, before)


def test_a_damaged_or_missing_exposure_is_refused(tmp_path: Path, changing: Scene) -> None:
    config = TrainConfig(max_steps=20, exposure=True)
    trainer = Trainer(config, changing)
    trainer.train(progress=False)
    path = tmp_path / "c.pt"
    trainer.save_checkpoint(path)
    whole = torch.load(path, weights_only=True)
    for name, wrong in (("affine", torch.eye(3, 4)), ("exp_avg", torch.full((8, 3, 4), math.nan)), ("affine", None)):
        state = {**whole, "registered": {"exposure": {**whole["registered"]["exposure"], name: wrong}}}
        torch.save(state, path)
        with pytest.raises(InputError, match="cannot be continued"):
            Trainer(config, changing).load_checkpoint(path)
    torch.save(whole, path)
    with pytest.raises(InputError, match="made with exposure=True, not False"):
        Trainer(dataclasses.replace(config, exposure=False), changing).load_checkpoint(path)
