"""Snapshots and checkpoints: interrupted and resumed equals uninterrupted, bit for bit."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from skipgs_plug import SkipGate
from skipgs_plug.trainer import InputError, MissingFileError, Scene, TrainConfig, Trainer


class Counter:
    """A registered object with state."""

    def __init__(self) -> None:
        self.value = 0

    def state_dict(self) -> dict[str, Any]:
        return {"value": self.value}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.value = state["value"]


def assert_same(one: Trainer, other: Trainer) -> None:
    first, second = one.snapshot(), other.snapshot()
    assert first["step"] == second["step"]
    for name in first["splats"]:
        assert torch.equal(first["splats"][name], second["splats"][name]), name
        for key, moment in first["optimizers"][name].items():
            assert torch.equal(moment, second["optimizers"][name][key]), (name, key)


@pytest.mark.parametrize("visible_adam", [False, True])
@pytest.mark.parametrize("stop", [6, 13, 45])
def test_resumed_equals_uninterrupted(
    tmp_path: Path, opaque_scene: Scene, tiny_config: TrainConfig, stop: int, visible_adam: bool
) -> None:
    config = dataclasses.replace(tiny_config, visible_adam=visible_adam, random_bkgd=True)
    whole = Trainer(config, opaque_scene)
    whole.train(progress=False)
    first = Trainer(config, opaque_scene)
    first.train(until=stop, progress=False)
    first.save_checkpoint(tmp_path / "c.pt")
    second = Trainer(config, opaque_scene)
    second.load_checkpoint(tmp_path / "c.pt")
    assert second.step == stop
    second.train(progress=False)
    assert_same(whole, second)


def test_snapshot_can_be_restored_twice(trainer: Trainer) -> None:
    trainer.train(until=30, progress=False)
    optimizer = trainer.optimizers["means"]
    snapshot = trainer.snapshot()
    ends = []
    for _ in range(2):
        trainer.restore(snapshot)
        assert trainer.step == 30 and trainer.optimizers["means"] is optimizer
        trainer.train(progress=False)
        ends.append(trainer.splats["means"].detach().clone())
    assert torch.equal(ends[0], ends[1])


def test_registered_state_travels(tmp_path: Path, trainer: Trainer) -> None:
    counter = Counter()
    trainer.register_state("counter", counter)
    counter.value = 7
    trainer.save_checkpoint(tmp_path / "c.pt")
    snapshot = trainer.snapshot()
    counter.value = 9
    trainer.restore(snapshot)
    assert counter.value == 7
    counter.value = 9
    trainer.load_checkpoint(tmp_path / "c.pt")
    assert counter.value == 7


def test_missing_registered_state_is_said(tmp_path: Path, trainer: Trainer, caplog: pytest.LogCaptureFixture) -> None:
    trainer.save_checkpoint(tmp_path / "c.pt")
    trainer.register_state("counter", Counter())
    trainer.load_checkpoint(tmp_path / "c.pt")
    assert "holds no state for counter: it starts fresh" in caplog.text


def test_bad_checkpoints(tmp_path: Path, trainer: Trainer, tiny_scene: Scene) -> None:
    path = tmp_path / "c.pt"
    with pytest.raises(MissingFileError, match=r"c\.pt does not exist"):
        trainer.load_checkpoint(path)
    trainer.save_checkpoint(path)
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"garbage"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"c\.pt is damaged or not one of this trainer"):
            trainer.load_checkpoint(path)
    torch.save({"step": 3}, path)
    with pytest.raises(InputError, match="damaged or not one"):
        trainer.load_checkpoint(path)

    path.write_bytes(whole)
    other = Trainer(dataclasses.replace(trainer.config, max_steps=90), tiny_scene)
    with pytest.raises(InputError, match=r"on a schedule of 60 iterations, not 90"):
        other.load_checkpoint(path)
    fewer = dataclasses.replace(tiny_scene, train=tiny_scene.train[1:])
    with pytest.raises(InputError, match="other training views"):
        Trainer(trainer.config, fewer).load_checkpoint(path)

    with torch.no_grad():
        trainer.splats["scales"][0, 0] = torch.inf
    trainer.save_checkpoint(path)
    with pytest.raises(InputError, match=r"holds NaN or infinite scales"):
        trainer.load_checkpoint(path)
    assert [p.name for p in tmp_path.iterdir()] == ["c.pt"]


def test_an_extended_run_keeps_its_schedule(tmp_path: Path, tiny_scene: Scene, tiny_config: TrainConfig) -> None:
    longer = dataclasses.replace(tiny_config, max_steps=80, schedule_steps=60)
    whole = Trainer(longer, tiny_scene)
    whole.train(progress=False)
    rate = whole.optimizers["means"].param_groups[0]["lr"]
    assert rate == pytest.approx(tiny_config.means_lr * tiny_scene.scene_scale * 0.01)
    assert whole.refine_stop_iter == 30
    for stop in (20, 60):
        first = Trainer(tiny_config, tiny_scene)
        first.train(until=stop, progress=False)
        first.save_checkpoint(tmp_path / "c.pt")
        second = Trainer(longer, tiny_scene)
        second.load_checkpoint(tmp_path / "c.pt")
        second.train(progress=False)
        assert_same(whole, second)
    shorter = Trainer(dataclasses.replace(tiny_config, max_steps=59, schedule_steps=60), tiny_scene)
    with pytest.raises(InputError, match=r"60 iterations old, more than max_steps=59"):
        shorter.load_checkpoint(tmp_path / "c.pt")


def test_a_checkpoint_older_than_a_setting_was_made_with_its_default_or_without_it(
    tmp_path: Path, trainer: Trainer, tiny_scene: Scene
) -> None:
    path = tmp_path / "c.pt"
    trainer.save_checkpoint(path)
    content = torch.load(path, weights_only=True)
    del content["config"]["exposure"]
    torch.save(content, path)
    trainer.load_checkpoint(path)
    with pytest.raises(InputError, match="was made with exposure=False, not True"):
        Trainer(dataclasses.replace(trainer.config, exposure=True), tiny_scene).load_checkpoint(path)
    del content["config"]["clear_depth"]  # nothing was pruned before this setting existed
    torch.save(content, path)
    with pytest.raises(InputError, match=r"was made with clear_depth=0.0, not 0.5"):
        trainer.load_checkpoint(path)
    Trainer(dataclasses.replace(trainer.config, clear_depth=0.0), tiny_scene).load_checkpoint(path)


WRONG = (None, "text", {"a": None}, torch.zeros(3), torch.full((160, 3), math.nan))
CHECKED_ELSEWHERE = ("config", "skipgs")  # compared one by one; see tests/core/test_state.py


def entries(state: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The paths of all entries of a checkpoint."""
    for key, value in state.items():
        yield (*path, key)
        if isinstance(value, dict) and key not in CHECKED_ELSEWHERE:
            yield from entries(value, (*path, key))


def test_an_entry_that_is_missing_or_of_another_type_is_an_error_or_harmless(
    tmp_path: Path, trainer: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every entry of a checkpoint is taken away once, and replaced by everything else once."""
    SkipGate(trainer)
    trainer.train(until=32, progress=False)
    trainer.save_checkpoint(tmp_path / "c.pt")
    whole = torch.load(tmp_path / "c.pt", weights_only=True)
    refused = taken = 0
    for path in entries(whole):
        for wrong in (KeyError, *WRONG):
            state = parent = dict(whole)
            for key in path[:-1]:
                parent[key] = parent = dict(parent[key])
            if wrong is KeyError:
                del parent[path[-1]]
            else:
                parent[path[-1]] = wrong
            monkeypatch.setattr(torch, "load", lambda *args, state=state, **kwargs: state)
            try:
                with trainer.backend.exclusive_cores():
                    trainer.load_checkpoint(tmp_path / "c.pt")
            except InputError as error:
                refused += 1
                assert len(str(error)) < 900
                continue
            taken += 1
            trainer.train_step()
    assert refused > 200 and taken > 2


def test_a_saturated_checkpoint_is_continued(trainer: Trainer, tmp_path: Path, caplog) -> None:
    """An opacity of 1 is infinite as a logit, a flat Gaussian has a scale of e^-inf."""
    with torch.no_grad():
        trainer.splats["opacities"][3] = torch.inf
        trainer.splats["scales"][4, 2] = -torch.inf
    trainer.save_checkpoint(tmp_path / "c.pt")
    trainer.load_checkpoint(tmp_path / "c.pt")
    assert "1 infinite opacities are read as finite numbers" in caplog.text
    assert all(bool(torch.isfinite(values).all()) for values in trainer.splats.values())
    trainer.train(until=5, progress=False)
