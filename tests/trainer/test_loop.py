"""The training loop learns, follows its schedule, resets opacities, and refuses input that it cannot use."""

from __future__ import annotations

import dataclasses
import threading

import pytest
import torch

from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer
from skipgs_plug.trainer.config import REFERENCE_STEPS
from skipgs_plug.trainer.order import ViewOrder
from skipgs_plug.trainer.seeded import seeded
from skipgs_plug.trainer.strategy import reset_interval, reset_opacity_if_missed


def test_training_improves_held_out_views(tiny_scene: Scene) -> None:
    trainer = Trainer(TrainConfig(max_steps=120), tiny_scene)
    before = trainer.evaluate()
    trainer.train(progress=False)
    after = trainer.evaluate()
    assert after["psnr"] > before["psnr"] + 1.5
    assert after["views"] == 2 and after["num_GS"] == len(trainer.splats["means"])
    assert trainer.t_total >= trainer.t_post > 0.0
    assert sum(trainer.phase_seconds.values()) == pytest.approx(trainer.t_total)


def test_schedule_scales_together_and_intervals_have_a_floor() -> None:
    full, tenth = TrainConfig(), TrainConfig(max_steps=REFERENCE_STEPS // 10)
    assert full.scaled(full.recipe.refine_stop_iter) == 15_000 and tenth.scaled(tenth.recipe.refine_stop_iter) == 1500
    assert tenth.scaled(tenth.sh_degree_interval) == 100
    assert tenth.scaled_interval(100, least=100) == 100 and full.scaled_interval(100, least=100) == 100
    assert tenth.scaled_interval(30, least=100) == 30


def test_sh_degree_and_positions_rate_follow_the_step(trainer: Trainer) -> None:
    assert [trainer.active_sh_degree(step) for step in (0, 9, 10, 20, 59)] == [0, 0, 1, 2, 3]
    trainer.train_step()
    first = trainer.optimizers["means"].param_groups[0]["lr"]
    assert first == pytest.approx(1.6e-4 * trainer.scene.scene_scale)
    trainer.train(progress=False)
    assert trainer.optimizers["means"].param_groups[0]["lr"] == pytest.approx(first * 0.01 ** (59 / 60))


def test_every_view_once_per_epoch() -> None:
    order = ViewOrder(7, seed=3)
    epochs = [[order.at(step) for step in range(7 * e, 7 * e + 7)] for e in range(3)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert epochs[0] != epochs[1]
    assert [ViewOrder(7, seed=3).at(step) for step in range(7, 14)] == epochs[1]
    assert [ViewOrder(7, seed=4).at(step) for step in range(7)] != epochs[0]


def test_densification_runs_and_ends(trainer: Trainer) -> None:
    start = len(trainer.splats["means"])
    trainer.train(until=trainer.refine_stop_iter, progress=False)
    densified = len(trainer.splats["means"])
    assert densified != start
    trainer.train(progress=False)
    assert len(trainer.splats["means"]) == densified


def test_opacities_are_reset_though_gsplat_1_5_3_does_not(trainer: Trainer) -> None:
    trainer.strategy.reset_every = 20
    trainer.train(until=20, progress=False)
    assert torch.sigmoid(trainer.splats["opacities"]).max() > 0.05
    trainer.train_step()  # step 20, a multiple of reset_every
    assert torch.sigmoid(trainer.splats["opacities"]).max() <= 0.01001
    # After a reset by the strategy or by a first call, nothing is left to do.
    args = (trainer.strategy, trainer.splats, trainer.optimizers, trainer.strategy_state)
    assert not reset_opacity_if_missed(*args, 20)
    with torch.no_grad():
        trainer.splats["opacities"].fill_(0.0)
    assert not reset_opacity_if_missed(*args, 21)
    assert not reset_opacity_if_missed(*args, 40)  # after densification
    assert reset_opacity_if_missed(*args, 20)
    moments = trainer.optimizers["opacities"].state[trainer.splats["opacities"]]
    assert not moments["exp_avg"].any()


@pytest.mark.parametrize(
    ("max_steps", "resets"),
    [(30_000, [3000, 6000, 9000, 12_000]), (15_000, [3750]), (3000, [])],
)
def test_short_runs_reset_opacities_in_time_to_recover(max_steps: int, resets: list[int]) -> None:
    config = TrainConfig(max_steps=max_steps)
    stop, every = config.scaled(config.recipe.refine_stop_iter), reset_interval(config)
    assert [step for step in range(1, stop) if step % every == 0] == resets


def test_backward_is_called_once_per_iteration_with_view_and_step(trainer: Trainer) -> None:
    calls: list[tuple[str, int]] = []
    original = trainer.backward

    def spy(loss: torch.Tensor, view: str, step: int) -> None:
        calls.append((view, step))
        original(loss, view, step)

    trainer.backward = spy  # type: ignore[method-assign]
    trainer.train(until=8, progress=False)
    assert [step for _, step in calls] == list(range(8))
    assert sorted(view for view, _ in calls) == sorted(trainer.view_names)


def test_iteration_without_backward_changes_nothing(trainer: Trainer) -> None:
    trainer.train(until=31, progress=False)
    before = trainer.snapshot()
    trainer.backward = lambda loss, view, step: None  # type: ignore[method-assign]
    trainer.train_step()
    after = trainer.snapshot()
    for name in before["splats"]:
        assert torch.equal(before["splats"][name], after["splats"][name])
        assert torch.equal(before["optimizers"][name]["exp_avg"], after["optimizers"][name]["exp_avg"])
    assert after["step"] == before["step"] + 1


def test_non_finite_loss_names_view_and_step(trainer: Trainer) -> None:
    trainer.train(until=3, progress=False)
    with torch.no_grad():
        trainer.splats["sh0"].fill_(torch.nan)
    with pytest.raises(InputError, match=r"Loss is nan at iteration 3 on view 'view_00\d\.png'"):
        trainer.train_step()


@pytest.mark.parametrize("field", ["visible_adam", "antialiased", "absgrad"])
def test_options_train(tiny_scene: Scene, tiny_config: TrainConfig, field: str) -> None:
    train_with(tiny_scene, tiny_config, field)


def train_with(scene: Scene, config: TrainConfig, field: str) -> None:
    """Check that training with an option stays finite and takes another course."""
    plain, varied = Trainer(config, scene), Trainer(dataclasses.replace(config, **{field: True}), scene)
    for trainer in (plain, varied):
        trainer.train(until=6, progress=False)
    assert all(torch.isfinite(p).all() for p in varied.splats.values())
    assert not torch.equal(plain.splats["means"], varied.splats["means"])


def test_random_backgrounds_train_opaque_photographs_alone(
    tiny_scene: Scene, opaque_scene: Scene, tiny_config: TrainConfig
) -> None:
    train_with(opaque_scene, tiny_config, "random_bkgd")
    with pytest.raises(InputError, match="leave out --random-bkgd"):
        Trainer(dataclasses.replace(tiny_config, random_bkgd=True), tiny_scene)


def test_absolute_gradients_decide_about_densification_only(tiny_scene: Scene, tiny_config: TrainConfig) -> None:
    # The threshold lies between the mean gradients and the larger means of their absolute values.
    config = dataclasses.replace(tiny_config, grow_grad2d=0.001)
    plain, absolute = (Trainer(dataclasses.replace(config, absgrad=absgrad), tiny_scene) for absgrad in (False, True))
    for trainer in (plain, absolute):
        trainer.train(until=4, progress=False)
    assert all(torch.equal(plain.splats[name], absolute.splats[name]) for name in plain.splats)
    sums = [trainer.strategy_state["grad2d"] for trainer in (plain, absolute)]
    assert (sums[1] >= sums[0]).all() and (sums[1] > sums[0]).any()
    for trainer in (plain, absolute):
        trainer.train(until=5, progress=False)
    assert len(tiny_scene.points) < len(plain.splats["means"]) < len(absolute.splats["means"])


def test_callers_random_state_is_left_alone(trainer: Trainer) -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    trainer.train(until=12, progress=False)
    assert torch.equal(torch.rand(3), expected)


def test_densification_initialises_no_gpu(trainer: Trainer, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a machine with GPUs, a training on the CPU asks none of them for its random state."""
    asked: list[object] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda device=None: asked.append(device) or torch.get_rng_state())
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda state, device=None: asked.append(device))
    with pytest.warns(UserWarning, match="CUDA reports"), torch.random.fork_rng():
        pass
    assert len(asked) == 4  # the check notices a fork that asks all devices
    asked.clear()
    start = trainer.num_gaussians
    trainer.train(until=trainer.refine_stop_iter, progress=False)
    assert trainer.num_gaussians != start and not asked


def test_trainers_in_other_threads_wait_while_one_draws() -> None:
    def draw(step: int) -> torch.Tensor:
        with seeded(step, torch.device("cpu")):
            return torch.rand(3)

    alone, drawn = draw(5), []
    other = threading.Thread(target=lambda: drawn.append(draw(9)))
    with seeded(5, torch.device("cpu")):
        other.start()
        other.join(0.2)
        assert torch.equal(torch.rand(3), alone) and not drawn
    other.join(10)
    assert torch.equal(drawn[0], draw(9))


def test_no_held_out_views(tiny_scene: Scene, tiny_config: TrainConfig) -> None:
    scene = dataclasses.replace(tiny_scene, test=[])
    with pytest.raises(InputError, match="has no test views; lower test_every"):
        Trainer(tiny_config, scene).evaluate()


@pytest.mark.parametrize(
    ("field", "value"),
    [("max_steps", 0), ("data_factor", 0), ("sh_degree", 4), ("ssim_lambda", 1.5), ("means_lr", float("nan"))],
)
def test_settings_out_of_range(field: str, value: float) -> None:
    with pytest.raises(InputError, match=field):
        TrainConfig(**{field: value})  # type: ignore[arg-type]


def test_unknown_backend(tiny_scene: Scene) -> None:
    with pytest.raises(InputError, match="Backend 'opengl' is unknown; choose"):
        Trainer(TrainConfig(backend="opengl"), tiny_scene)  # type: ignore[arg-type]
