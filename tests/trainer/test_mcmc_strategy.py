"""Densification by gsplat's MCMCStrategy: moves, noise, resume, gate; in the units of any scene."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from always import Always
from interrupted import whole_and_resumed

from skipgs_plug import SkipGate
from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer
from skipgs_plug.trainer.config import RECIPES
from skipgs_plug.trainer.synthetic import make_scene

STEPS = 60
CAP = 200


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(n_views=10, width=32, height=24, n_points=160)


def trainer_of(scene: Scene, **settings: object) -> Trainer:
    config = {"max_steps": STEPS, "strategy": "mcmc", "cap_max": CAP, "refine_every": 5, **settings}
    return Trainer(TrainConfig(**config), scene)


def test_a_cap_below_the_start_is_named(scene: Scene, caplog: pytest.LogCaptureFixture) -> None:
    trainer_of(scene, cap_max=160)
    assert not caplog.records
    trainer = trainer_of(scene, cap_max=100)
    assert "starts with 160 Gaussians, more than cap_max=100" in caplog.text
    trainer.train(until=20, progress=False)
    assert trainer.num_gaussians == 160


def test_it_grows_to_its_cap_and_no_further(scene: Scene) -> None:
    trainer = trainer_of(scene)
    sizes, before = [], trainer.evaluate()["psnr"]
    trainer.on_step = lambda _: sizes.append(len(trainer.splats["means"]))
    state = torch.random.get_rng_state()
    trainer.train(progress=False)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert sizes[4] == 160 < sizes[5] == 168 and max(sizes) == sizes[-1] == CAP
    assert trainer.refine_stop_iter == 50 and trainer.evaluate()["psnr"] > before + 0.3


def test_dead_gaussians_move_to_live_ones(scene: Scene) -> None:
    trainer = trainer_of(scene, noise_lr=0.0, cap_max=160)
    trainer.train(until=5, progress=False)
    with torch.no_grad():
        trainer.splats["opacities"][:20] = -20.0
        trainer.splats["means"][:20] = 1000.0
    trainer.train(until=6, progress=False)
    moved = trainer.splats["means"][:20].detach()
    assert (torch.sigmoid(trainer.splats["opacities"]) >= 0.0049).all() and moved.abs().max() < 100
    distances = (moved[:, None] - trainer.splats["means"][20:].detach()).norm(dim=2)
    assert distances.min(dim=1).values.max() < 1e-4


@pytest.mark.parametrize("settings", [{}, {"refine_share": 0.4}, None])
@pytest.mark.parametrize("stop", [13, 53])
def test_resumed_equals_uninterrupted(tmp_path: Path, scene: Scene, stop: int, settings: dict | None) -> None:
    def made() -> Trainer:
        trainer = trainer_of(scene)
        if settings is not None:
            SkipGate(trainer, **settings)
        return trainer

    whole, second = whole_and_resumed(made, stop, tmp_path / "c.pt")
    assert all(torch.equal(whole.splats[name], second.splats[name]) for name in whole.splats)


def test_the_noise_is_left_out_where_the_update_is(scene: Scene) -> None:
    trainer = trainer_of(scene)
    with SkipGate(trainer, policy=Always()) as gate:
        trainer.train(until=trainer.refine_stop_iter, progress=False)
        before = {name: value.detach().clone() for name, value in trainer.splats.items()}
        trainer.train(progress=False)
        assert gate.stats()["backwards_skipped"] == STEPS - 50
    assert all(torch.equal(trainer.splats[name], before[name]) for name in before)


def test_a_gate_that_starts_early_leaves_the_moves(scene: Scene) -> None:
    trainer = trainer_of(scene)
    with SkipGate(trainer, start_iter=10, policy=Always()):
        trainer.train(progress=False)
    assert len(trainer.splats["means"]) == CAP


def test_a_scene_of_another_size_trains_alike(scene: Scene) -> None:
    unit = 128.0  # a power of two, so that no digit is rounded
    views = {}
    for split in ("train", "test"):
        views[split] = []
        for view in getattr(scene, split):
            viewmat = view.viewmat.clone()
            viewmat[:3, 3] *= unit
            views[split].append(dataclasses.replace(view, viewmat=viewmat))
    large = dataclasses.replace(scene, points=scene.points * unit, scene_scale=scene.scene_scale * unit, **views)
    ends = [trainer_of(one, near_plane=0.01 * size) for one, size in ((scene, 1.0), (large, unit))]
    for trainer in ends:
        trainer.train(until=30, progress=False)
    first, second = (trainer.splats for trainer in ends)
    assert len(first["means"]) == len(second["means"])
    assert torch.allclose(first["means"] * unit, second["means"], rtol=1e-2, atol=0.02 * large.scene_scale)
    assert torch.allclose(first["opacities"], second["opacities"], atol=0.05)


def test_settings_that_belong_to_the_other_strategy_are_refused() -> None:
    with pytest.raises(InputError, match="cap_max belongs to strategy mcmc, but strategy is default; leave it out"):
        TrainConfig(cap_max=10)
    with pytest.raises(InputError, match="grow_grad2d belongs to strategy default"):
        TrainConfig(strategy="mcmc", grow_grad2d=0.1)
    with pytest.raises(InputError, match="strategy='taming' is unknown"):
        TrainConfig(strategy="taming")  # type: ignore[arg-type]


def test_presets_are_those_of_gsplat_and_give_way_to_what_is_given() -> None:
    from gsplat import DefaultStrategy, MCMCStrategy

    assert RECIPES["default"].refine_stop_iter == DefaultStrategy().refine_stop_iter
    theirs = MCMCStrategy()
    config = TrainConfig(strategy="mcmc")
    assert config.recipe.refine_stop_iter == theirs.refine_stop_iter
    assert (config.cap_max, config.noise_lr, config.prune_opa) == (theirs.cap_max, theirs.noise_lr, theirs.min_opacity)
    given = TrainConfig(strategy="mcmc", init_opa=0.3, scale_reg=0.0).recipe
    assert (given.init_opa, given.init_scale, given.opacity_reg, given.scale_reg) == (0.3, 0.1, 0.01, 0.0)
