"""A bench small enough to run whole."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from skipgs_plug.bench.policies import POLICIES
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.bench.runner import Bench
from skipgs_plug.bench.store import BenchFolder
from skipgs_plug.core import budget
from skipgs_plug.trainer import Scene, TrainConfig

MAX_STEPS = 80  # densification ends at 40, warm-up at 52 (two visits of six views)
SEEDS = (0, 1)


@contextlib.contextmanager
def early_floor() -> Iterator[None]:
    """Put the floor in force after 20 recorded iterations: before 100 of them the gate may skip everything."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(budget, "MIN_SAMPLES", 20)
        yield


def make_bench(scene: Scene, folder: Path, **changes: Any) -> Bench:
    """Return a quiet bench; `changes` replace arguments of Bench, or `max_steps`."""
    config = TrainConfig(max_steps=changes.pop("max_steps", MAX_STEPS))
    arguments = {"seeds": SEEDS, "policies": tuple(POLICIES), "say": lambda line: None, "progress": False, **changes}
    return Bench(scene, config, BenchFolder(folder), **arguments)


@dataclass
class Finished:
    """A bench that ran: itself, its records by (seed, policy), and its folder."""

    bench: Bench
    records: list[RunRecord]
    folder: Path

    def run(self, policy: str, seed: int = 0) -> RunRecord:
        return next(r for r in self.records if (r.seed, r.policy) == (seed, policy))
