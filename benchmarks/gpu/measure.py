"""Runs the trainer of this package with and without gates from one snapshot: waits, peak memory, seconds, PSNR."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from benchmarks.gpu.machine import Machine
from skipgs_plug import SkipGate
from skipgs_plug.trainer import TrainConfig, Trainer
from skipgs_plug.trainer.backend import Backend
from skipgs_plug.trainer.scene import Scene

GATES: dict[str, dict[str, Any]] = {
    "off": {"enabled": False},
    "gate": {"min_bwd_ratio": 0.0},  # no minimum of backward passes: as many skips as possible
    "refine_share 0.4": {"refine_share": 0.4},
}
COUNTED = 20  # iterations whose waits are counted
TRIAL = 30  # iterations that measure the speed of this machine
SHORTEST, LONGEST = 600, 30_000  # bounds of the schedule, iterations


class Deadline:
    """A time limit."""

    def __init__(self, seconds: float, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._end = now() + seconds

    @property
    def left(self) -> float:
        """Seconds until the time limit, at least 0."""
        return max(self._end - self._now(), 0.0)


def schedule(seconds: float, seconds_per_iteration: float) -> int:
    """Return the iterations of a schedule. Its densification runs once, its refinement once for each gate.

    Args:
        seconds: Time limit of all runs.
        seconds_per_iteration: Measured at the beginning. Later iterations have more Gaussians and take twice as long.
    """
    runs = 0.5 + 0.5 * len(GATES)
    wanted = int(seconds / (2.0 * seconds_per_iteration * runs))
    return min(max(wanted // 100 * 100, SHORTEST), LONGEST)


def compare(scene: Scene, backend: Backend, machine: Machine, deadline: Deadline, steps: int | None = None) -> dict:
    """Train to the end of densification, then refine from there once with each gate.

    Args:
        scene: Scene to train on.
        backend: Rasterizer and device.
        machine: Measures the device.
        deadline: Time limit. No refinement starts if less time is left than the longest one took.
        steps: Iterations of the schedule; if None, the speed of the machine determines them.

    Returns:
        `schedule` (iterations), `num_GS`, `t_densify` (seconds) and `runs`, by gate: `waits_per_iteration`,
        `peak_bytes`, `peak_bytes_first_skip` (None without a skip), `t_post`, `t_total` (seconds), `psnr`,
        `iterations`, `backwards_skipped`.
    """
    if steps is None:
        steps = schedule(0.8 * deadline.left, _trial(scene, backend, machine))
    trainer = Trainer(TrainConfig(max_steps=steps), scene, backend)
    trainer.train(trainer.refine_stop_iter, progress=False)
    snapshot = trainer.snapshot()
    result: dict[str, Any] = {
        "schedule": steps,
        "num_GS": trainer.num_gaussians,
        "t_densify": trainer.t_total,
        "runs": {},
        "left_out": [],
    }
    longest = 0.0
    for name, settings in GATES.items():
        if deadline.left < longest:
            result["left_out"].append(name)
            continue
        began = deadline.left
        result["runs"][name] = _refine(trainer, snapshot, settings, machine)
        longest = max(longest, began - deadline.left)
    return result


def _trial(scene: Scene, backend: Backend, machine: Machine) -> float:
    """Measure the seconds of one early iteration."""
    trainer = Trainer(TrainConfig(max_steps=LONGEST), scene, backend)
    trainer.train(5, progress=False)
    began = time.monotonic()
    trainer.train(5 + TRIAL, progress=False)
    machine.synchronize()
    return (time.monotonic() - began) / TRIAL


def _refine(trainer: Trainer, snapshot: dict[str, Any], settings: dict[str, Any], machine: Machine) -> dict[str, Any]:
    trainer.restore(snapshot)
    before = trainer.t_total
    machine.reset_peak()
    overall = 0
    with SkipGate(trainer, **settings) as gate:
        with machine.waits() as waits:
            ran = trainer.ran
            trainer.train(trainer.step + COUNTED, progress=False)
            counted = max(trainer.ran - ran, 1)
        overall = max(overall, machine.peak_bytes())
        first_skip = None
        skipped: list[bool] = []

        def look(_: Any) -> None:
            nonlocal first_skip, overall
            if skipped and first_skip is None:
                first_skip = machine.peak_bytes()  # peak over the iteration after the first skip
            if first_skip is None and not skipped and gate.skipped:
                skipped.append(True)
                overall = max(overall, machine.peak_bytes())
                machine.reset_peak()

        trainer.on_step = look
        trainer.train(progress=False)
        trainer.on_step = None
        overall = max(overall, machine.peak_bytes())
        stats = gate.stats()
    return {
        "waits_per_iteration": waits[0] / counted,
        "peak_bytes": overall,
        "peak_bytes_first_skip": first_skip,
        "t_post": trainer.t_total - before,
        "t_total": trainer.t_total,
        "psnr": trainer.evaluate("test" if trainer.scene.test else "train")["psnr"],
        "iterations": stats["iterations"],
        "backwards_skipped": stats["backwards_skipped"],
    }
