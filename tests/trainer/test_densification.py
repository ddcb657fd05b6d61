"""Densification that moves every row once has the same result as gsplat's strategy."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import gsplat
import pytest
import torch
from test_resume import assert_same
from torch import nn

from skipgs_plug.fallback_raster.training.gradient_norms import sum_norms
from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer
from skipgs_plug.trainer.densification import densify
from skipgs_plug.trainer.loop import Iteration
from skipgs_plug.trainer.row_order import sort_rows


def seen(n: int, seed: int = 0) -> dict[str, Any]:
    """Return a rasterizer's `info` for an image that shows half of n Gaussians."""
    generator = torch.Generator().manual_seed(seed)
    ids = torch.randperm(n, generator=generator)[: n // 2]
    means2d = torch.randn(len(ids), 2, generator=generator).requires_grad_()
    means2d.grad = torch.randn(len(ids), 2, generator=generator)
    means2d.absgrad = means2d.grad.abs() * 2  # type: ignore[attr-defined]
    radii = torch.ones(len(ids), 2, dtype=torch.int32)
    return {"means2d": means2d, "gaussian_ids": ids, "radii": radii, "width": 37, "height": 21, "n_cameras": 1}


def trained(config: TrainConfig, scene: Scene) -> Trainer:
    """A trainer with moments, and with Gaussians of which some are to be cloned, split and pruned."""
    trainer = Trainer(dataclasses.replace(config, refine_stop_iter=1, sh_degree_interval=1), scene)
    trainer.train(until=8, progress=False)
    generator = torch.Generator().manual_seed(3)
    n = trainer.num_gaussians
    with torch.no_grad():
        trainer.splats["scales"][torch.rand(n, generator=generator) < 0.5] += 4.0
        trainer.splats["opacities"][torch.rand(n, generator=generator) < 0.2] = -9.0
    trainer.strategy.refine_start_iter, trainer.strategy.refine_stop_iter = 1, 30
    trainer.strategy_state["grad2d"] = torch.rand(n, generator=generator) * 2 * trainer.strategy.grow_grad2d
    trainer.strategy_state["count"] = torch.ones(n)
    return trainer


@pytest.mark.parametrize("in_order", [False, True])
def test_rows_and_moments_are_those_of_gsplat(tiny_config: TrainConfig, tiny_scene: Scene, in_order: bool) -> None:
    ours, theirs = trained(tiny_config, tiny_scene), trained(tiny_config, tiny_scene)
    assert_same(ours, theirs)
    n, parameters = ours.num_gaussians, dict(ours.splats.items())
    for trainer in (ours, theirs):
        trainer.strategy_state["more"] = torch.arange(n)  # gsplat moves the rows of every tensor in its state
    info = seen(n)
    torch.manual_seed(5)
    densify(ours.strategy, ours.splats, ours.optimizers, ours.strategy_state, 8, copy.copy(info), in_order)
    torch.manual_seed(5)
    args = (theirs.splats, theirs.optimizers, theirs.strategy_state)
    theirs.strategy.step_post_backward(*args, 8, info, packed=True)
    if in_order:
        sort_rows(*args)
    assert ours.num_gaussians != n
    assert_same(ours, theirs)
    for name, param in ours.splats.items():
        assert isinstance(param, nn.Parameter) and param is not parameters[name] and param.requires_grad
        (held,) = ours.optimizers[name].param_groups[0]["params"]
        assert held is param and list(ours.optimizers[name].state) == [param]
        moment = ours.optimizers[name].state[param]["exp_avg"]
        assert moment.shape == param.shape and moment.any()
    assert torch.equal(ours.strategy_state["more"], theirs.strategy_state["more"])
    assert not ours.strategy_state["grad2d"].any() and len(ours.strategy_state["count"]) == ours.num_gaussians


@pytest.mark.parametrize("in_order", [False, True])
def test_where_no_row_changes_parameters_stay_and_only_move(
    tiny_config: TrainConfig, tiny_scene: Scene, in_order: bool
) -> None:
    trainer = Trainer(dataclasses.replace(tiny_config, refine_stop_iter=1), tiny_scene)
    trainer.train(until=8, progress=False)
    trainer.strategy.refine_start_iter, trainer.strategy.refine_stop_iter = 1, 30
    trainer.strategy.grow_grad2d, trainer.strategy.prune_opa = 1e9, 0.0
    parameters = dict(trainer.splats.items())
    before = parameters["means"].detach().clone()
    args = (trainer.strategy, trainer.splats, trainer.optimizers, trainer.strategy_state)
    densify(*args, 8, seen(trainer.num_gaussians), in_order)
    assert all(trainer.splats[name] is param for name, param in parameters.items())
    assert torch.equal(before, parameters["means"]) is not in_order
    assert torch.equal(before.sort(dim=0).values, parameters["means"].sort(dim=0).values)


def test_an_optimizer_that_never_stepped_goes_on_with_the_new_parameter(
    tiny_config: TrainConfig, tiny_scene: Scene
) -> None:
    trainer = trained(tiny_config, tiny_scene)
    trainer.optimizers["quats"].state.clear()
    args = (trainer.strategy, trainer.splats, trainer.optimizers, trainer.strategy_state)
    densify(*args, 8, seen(trainer.num_gaussians), False)
    assert trainer.optimizers["quats"].param_groups[0]["params"][0] is trainer.splats["quats"]
    assert not trainer.optimizers["quats"].state


def test_an_opacity_reset_within_forgets_the_moments_of_opacities_alone(
    tiny_config: TrainConfig, tiny_scene: Scene
) -> None:
    """A gsplat whose reset works resets in `step_post_backward`."""
    trainer = trained(tiny_config, tiny_scene)
    trainer.strategy.grow_grad2d = trainer.strategy.grow_scale3d = 1e9
    step_post_backward = trainer.strategy.step_post_backward

    def repaired(params: Any, optimizers: Any, state: Any, step: int, *args: Any, **options: Any) -> None:
        step_post_backward(params, optimizers, state, step, *args, **options)
        gsplat.strategy.ops.reset_opa(params, optimizers, state, value=2 * trainer.strategy.prune_opa)

    trainer.strategy.step_post_backward = repaired
    args = (trainer.strategy, trainer.splats, trainer.optimizers, trainer.strategy_state)
    densify(*args, 8, seen(trainer.num_gaussians), False)
    assert torch.sigmoid(trainer.splats["opacities"]).max() <= 0.01001
    for name, param in trainer.splats.items():
        moments = trainer.optimizers[name].state[param]
        assert bool(moments["exp_avg"].any()) is (name != "opacities"), name
        assert moments["step"] == 8


@pytest.mark.parametrize("absgrad", [False, True])
def test_the_kernels_sums_are_those_of_gsplat(tiny_config: TrainConfig, tiny_scene: Scene, absgrad: bool) -> None:
    trainer = Trainer(dataclasses.replace(tiny_config, absgrad=absgrad), tiny_scene)
    n = trainer.num_gaussians
    own, theirs = (strategy.initialize_state() for strategy in [trainer.strategy] * 2)
    for number in range(3):
        info = seen(n, number)
        trainer.strategy._update_state(trainer.splats, own, info, packed=True)
        gsplat.DefaultStrategy._update_state(trainer.strategy, trainer.splats, theirs, info, packed=True)
    torch.testing.assert_close(own["grad2d"], theirs["grad2d"], rtol=1e-6, atol=0)
    assert torch.equal(own["count"], theirs["count"]) and own["count"].max() == 3


def test_sums_add_up_for_the_rows_of_an_image_only() -> None:
    norms, counts = torch.ones(4), torch.zeros(4)
    rows = torch.tensor([3, 1], dtype=torch.int32)
    sum_norms(rows, torch.tensor([[3.0, 2.0], [0.0, -1.0]]), (1.0, 2.0), norms, counts)
    assert norms.tolist() == [1.0, 3.0, 1.0, 6.0]
    assert counts.tolist() == [0.0, 1.0, 0.0, 1.0]
    sum_norms(rows[:0], torch.zeros(0, 2), (1.0, 1.0), norms, counts)
    assert counts.sum() == 2.0


def test_a_run_moves_its_rows_once_at_every_densification(
    tiny_config: TrainConfig, tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    from skipgs_plug.trainer import densifier

    at: list[int] = []
    sizes: list[int] = []

    def noted(strategy: Any, splats: Any, optimizers: Any, state: Any, step: int, *args: Any, **options: Any) -> None:
        at.append(step)
        densify(strategy, splats, optimizers, state, step, *args, **options)

    def look(iteration: Iteration) -> None:
        sizes.append(trainer.num_gaussians)

    monkeypatch.setattr(densifier, "densify", noted)
    trainer = Trainer(tiny_config, tiny_scene)
    trainer.on_step = look
    trainer.train(until=30, progress=False)
    changed = [step for step in range(1, 30) if sizes[step] != sizes[step - 1]]
    assert changed and set(changed) <= set(at)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_model_without_gaussians_is_refused(tiny_scene: Scene, strategy: str) -> None:
    config = TrainConfig(max_steps=40, strategy=strategy, refine_start_iter=0, refine_every=1, prune_opa=1.0)
    trainer = Trainer(config, tiny_scene)
    with pytest.raises(InputError, match="Densification in iteration 2 leaves no Gaussian; lower prune_opa"):
        trainer.train(progress=False)
