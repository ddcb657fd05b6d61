"""A few of the kills of `python -m benchmarks.soak`: a run that is killed at any moment ends like one that is not."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from benchmarks.soak_runs import Run, assert_same, kill_at_random, make_tiny_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_scene(tmp_path_factory.mktemp("scene"))


@pytest.mark.parametrize(("gated", "number"), [(True, signal.SIGKILL), (False, signal.SIGTERM)])
def test_killed_at_random_moments(scene: Path, tmp_path: Path, gated: bool, number: signal.Signals) -> None:
    done = kill_at_random(scene, tmp_path, gated, number, kills=2, seed=1, say=print)
    assert done["kills"] >= 2 and done["runs"] >= 1


@pytest.fixture(scope="module")
def whole(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A gated run that was not interrupted."""
    run = Run(scene, tmp_path_factory.mktemp("whole") / "run", gated=True, save_every=50)
    run.finish()
    return run.out


# A run writes nine files in this order: owner of the lock, cfg.yml, two checkpoints, two renders, stats, PLY, report.
@pytest.mark.parametrize("fault", [("killed before", 4), ("killed after", 5), ("disk full", 4)])
def test_killed_while_a_file_is_written(scene: Path, tmp_path: Path, whole: Path, fault: tuple[str, int]) -> None:
    run = Run(scene, tmp_path / "run", gated=True, save_every=50)
    code = run.expect(run.start(fault), {2, -signal.SIGKILL})
    assert (code == 2) == (fault[0] == "disk full")
    run.finish()
    assert_same(run.out, whole)
