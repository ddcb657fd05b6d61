"""One run: refine the snapshot of a seed under one policy, evaluating outside the clock."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from skipgs_plug import SkipGate
from skipgs_plug.bench.controls import PlannedSkipping, periodic_skipping, random_skipping
from skipgs_plug.bench.policies import PolicySpec
from skipgs_plug.bench.record import Point, RunRecord, Trace
from skipgs_plug.trainer import Trainer
from skipgs_plug.trainer.loop import Iteration
from skipgs_plug.trainer.scalars import ScalarLog

EVALUATIONS = 5  # after this many equal parts of refinement, and once before


class DivergedError(Exception):
    """A loss or a metric is not finite any more; one sentence says where."""


def densify(trainer: Trainer, progress: bool = True, scalars: Path | None = None) -> None:
    """Train up to the end of densification; `scalars` as in `refine`.

    Raises:
        DivergedError: a loss is not finite.
    """
    with finite_losses(trainer), logged(trainer, scalars) as log:
        trainer.on_step = None if log is None else log.iteration
        trainer.train(until=trainer.refine_stop_iter, progress=progress)
        trainer.on_step = None


def refine(
    trainer: Trainer,
    snapshot: dict[str, Any],
    spec: PolicySpec,
    earlier: dict[str, RunRecord],
    lpips_net: str | None = None,
    scalars: Path | None = None,
) -> RunRecord:
    """Refine `snapshot` to the end of the schedule under one policy.

    Args:
        earlier: runs of the same seed by policy, of which a control copies rate or time.
        lpips_net: also measure LPIPS with this backbone.
        scalars: folder for TensorBoard scalars.

    Raises:
        DivergedError: a loss or a metric is not finite.
    """
    trainer.restore(snapshot)
    start = trainer.refine_stop_iter
    iterations = trainer.max_steps - start
    if spec.name == "shortened":
        iterations = shortened_iterations(iterations, earlier["gate"].t_post, earlier["ungated"].t_post)
    phases_before = dict(trainer.phase_seconds)
    record = RunRecord(trainer.config.seed, spec.name, iterations=iterations, trace=Trace(start))
    if trainer.backend.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(trainer.backend.device)
    with (
        compressed(trainer, start, iterations),
        gated(trainer, spec, earlier) as gate,
        finite_losses(trainer),
        logged(trainer, scalars, gate) as log,
    ):
        record_losses(trainer, record, gate, log)
        record.points.append(evaluate(trainer, log))
        for part in range(1, EVALUATIONS + 1):
            trainer.train(until=start + round(part * iterations / EVALUATIONS), progress=False)
            if part < EVALUATIONS:
                record.points.append(evaluate(trainer, log))
        trainer.on_step = None
        if trainer.backend.device.type == "cuda":
            record.peak_memory = torch.cuda.max_memory_allocated(trainer.backend.device)
        stats = trainer.evaluate("test", lpips_net)
        record.points.append(point(trainer, stats, log))
    names = ["psnr", "ssim", "num_GS"] + [name for name in stats if name.startswith("lpips")]
    record.metrics = {name: stats[name] for name in names}
    record.t_post, record.t_total = trainer.t_post, trainer.t_total
    record.phases = {name: seconds - phases_before[name] for name, seconds in trainer.phase_seconds.items()}
    record.backwards = iterations
    if gate is not None:
        report = gate.report()
        record.backwards = report["backwards_run"]
        record.warm_up = sum(row.reason == "warm-up" for row in gate.trace)
        record.floor = report["min_bwd_ratio_effective"]
        record.reasons = report["reasons"]
    return record


def shortened_iterations(iterations: int, gate_seconds: float, ungated_seconds: float) -> int:
    """Return how many ungated iterations take as long as the gated refinement did."""
    return min(iterations, max(1, round(iterations * gate_seconds / ungated_seconds)))


@contextlib.contextmanager
def gated(trainer: Trainer, spec: PolicySpec, earlier: dict[str, RunRecord]) -> Iterator[SkipGate | None]:
    """Attach the gate that `spec` asks for; None for runs without."""
    # A loss that is not finite ends the run: a bench must not average over it.
    if spec.gate_settings is not None:
        gate = SkipGate(trainer, record_trace=True, on_nonfinite="raise", **spec.gate_settings)
    elif spec.name in ("random", "periodic"):
        policy = control(spec.name, trainer, earlier["gate"])
        gate = SkipGate(trainer, policy=policy, record_trace=True, on_nonfinite="raise")
    else:
        yield None
        return
    with gate:
        yield gate
        gate.verify()


def control(name: str, trainer: Trainer, gate: RunRecord) -> PlannedSkipping:
    """Return the control that skips as often as `gate` did, after the same warm-up."""
    first, end = trainer.refine_stop_iter + gate.warm_up, trainer.max_steps
    if name == "random":
        return random_skipping(first, end, gate.skips, trainer.config.seed)
    return periodic_skipping(first, end, gate.skips)


@contextlib.contextmanager
def compressed(trainer: Trainer, start: int, iterations: int) -> Iterator[None]:
    """Let `iterations` iterations from `start` run through the schedule of all that are left.

    Learning rate and SH degree of an iteration are those that a full run has at the same share of its way.
    """
    stretch = (trainer.max_steps - start) / iterations

    def stretched(step: float) -> float:
        return start + (step - start) * stretch if step > start else step

    rate, degree = trainer.set_learning_rate, trainer.active_sh_degree
    trainer.set_learning_rate = lambda step: rate(stretched(step))  # type: ignore[method-assign]
    trainer.active_sh_degree = lambda step: degree(int(stretched(step)))  # type: ignore[method-assign]
    try:
        yield
    finally:
        del trainer.set_learning_rate, trainer.active_sh_degree


@contextlib.contextmanager
def finite_losses(trainer: Trainer) -> Iterator[None]:
    """Raise DivergedError before the backward of the first loss that is not finite."""
    inner, was_own = trainer.backward, "backward" in vars(trainer)

    def checked(loss: torch.Tensor, view: str, step: int) -> None:
        value = float(loss.detach())
        if not math.isfinite(value):
            raise DivergedError(f"loss {value} at iteration {step} on view {view}")
        inner(loss, view, step)

    trainer.backward = checked  # type: ignore[method-assign]
    try:
        yield
    finally:
        if was_own:
            trainer.backward = inner  # type: ignore[method-assign]
        else:
            del trainer.backward


@contextlib.contextmanager
def logged(trainer: Trainer, scalars: Path | None, gate: SkipGate | None = None) -> Iterator[ScalarLog | None]:
    """Open TensorBoard scalars in a folder, if one is given."""
    if scalars is None:
        yield None
        return
    with ScalarLog(scalars, trainer, gate.scalars if gate is not None else dict) as log:
        yield log


def record_losses(trainer: Trainer, record: RunRecord, gate: SkipGate | None, log: ScalarLog | None) -> None:
    """Fill the trace of `record`, and the log, after every iteration, outside the clock."""
    index = {name: i for i, name in enumerate(trainer.view_names)}
    trace = record.trace
    assert trace is not None

    def on_step(iteration: Iteration) -> None:
        if gate is None:
            trace.add(index[iteration.view], iteration.loss, None, "ungated", False)
        else:
            row = gate.trace[-1]
            trace.add(index[row.view], row.loss, row.mean, row.reason, row.skip)
        if log is not None:
            log.iteration(iteration)

    trainer.on_step = on_step


def evaluate(trainer: Trainer, log: ScalarLog | None) -> Point:
    return point(trainer, trainer.evaluate("test"), log)


def point(trainer: Trainer, stats: dict[str, Any], log: ScalarLog | None) -> Point:
    if log is not None:
        log.evaluation(stats)
    if not (math.isfinite(stats["psnr"]) and math.isfinite(stats["ssim"])):
        raise DivergedError(f"held-out PSNR {stats['psnr']}, SSIM {stats['ssim']} after iteration {trainer.step - 1}")
    return Point(trainer.step, trainer.t_post, stats["psnr"], stats["ssim"])
