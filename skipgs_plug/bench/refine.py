"""One run: refine a densified model under one policy, evaluating outside the clock."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import torch

from skipgs_plug import SkipGate
from skipgs_plug.bench.memory import memory_meter
from skipgs_plug.bench.policies import REFERENCE, Earlier, RefineBenchPolicy
from skipgs_plug.bench.record import Point, RunRecord, Trace
from skipgs_plug.trainer import Trainer
from skipgs_plug.trainer.loop import Iteration
from skipgs_plug.trainer.metrics import METRICS, chosen
from skipgs_plug.trainer.scalars import ScalarLog

PARTS = 10  # parts of refinement, each followed by an evaluation; policies take turns by part


MOST_DB = 100.0  # PSNR of an image in dB, at most: an exact image, such as bare background, has an infinite PSNR


class RunDivergedError(Exception):
    """A loss or a metric is no longer finite. The message says where."""


class NotRunError(Exception):
    """A policy has no meaning for this run. The message says why."""


def densify(trainer: Trainer, progress: bool = True, scalars: Path | None = None) -> None:
    """Train up to the end of densification; `scalars` is a folder for TensorBoard scalars.

    Raises:
        RunDivergedError: A loss is not finite.
    """
    with finite_losses(trainer), logged(trainer, scalars) as log:
        trainer.on_step = None if log is None else log.iteration
        trainer.train(until=trainer.refine_stop_iter, progress=progress)
        trainer.on_step = None


def refine(
    trainer: Trainer,
    spec: RefineBenchPolicy,
    earlier: Earlier,
    lpips_net: str | None = None,
    scalars: Path | None = None,
) -> Generator[None, None, RunRecord]:
    """Refine to the end of the schedule under one policy, in PARTS equal parts with a pause after each but the last.

    Args:
        trainer: A trainer for this run alone, at the end of densification.
        spec: The policy.
        earlier: Finished runs of the same seed by policy. Controls copy their rate or time.
        lpips_net: Backbone of LPIPS; None for no LPIPS.
        scalars: Folder for TensorBoard scalars.

    Returns:
        The record, as the generator's value.

    Raises:
        RunDivergedError: A loss or a metric is not finite.
    """
    start, iterations = trainer.refine_stop_iter, spec.iterations(trainer, earlier)
    phases_before = dict(trainer.phase_seconds)
    trace = Trace(start)
    record = RunRecord(trainer.config.seed, spec.name, iterations=iterations, trace=trace)
    gate = spec.gate(trainer, earlier)
    with (
        gate or contextlib.nullcontext(),
        compressed(trainer, start, iterations),
        finite_losses(trainer),
        logged(trainer, scalars, gate) as log,
        recorded(trainer, trace, gate, log),
    ):
        record.points.append(point(trainer, trainer.evaluate("test"), log, trainer.t_post))
        for part in range(1, PARTS + 1):
            with peak_memory(trainer, record):
                trainer.train(until=start + round(part * iterations / PARTS), progress=False)
            if part < PARTS:
                record.points.append(point(trainer, trainer.evaluate("test"), log, trainer.t_post))
                yield
        stats = trainer.evaluate("test", lpips_net)
        record.points.append(point(trainer, stats, log, trainer.t_post))
        record.metrics, record.exact_views = measured(stats)
        record.train_metrics, _ = measured(trainer.evaluate("train"))
        if gate is not None:
            gate.verify()
    trace.fill(start + iterations)
    record.t_post, record.t_total, record.seconds = trainer.t_post, trainer.t_total, trainer.clock.seconds()
    record.phases = {name: seconds - phases_before[name] for name, seconds in trainer.phase_seconds.items()}
    record.iterations_run = record.backwards = sum(trace.ran)
    if gate is not None:
        report = gate.report()
        record.backwards -= report["backwards_skipped"]
        record.warm_up = sum(row.reason == "warm-up" for row in gate.trace)
        record.floor = report["min_bwd_ratio_effective"]
        record.gaussians_shown = report["gaussians_shown"]
        record.reasons = report["reasons"]
    return record


def measured(stats: dict[str, Any]) -> tuple[dict[str, float], int]:
    """Return the metrics and the model's size in an evaluation, and the number of views that are rendered exactly.

    The PSNR of such a view is infinite. It counts as MOST_DB, so that the mean is over all views.
    """
    found = {name: stats[name] for name in (*METRICS, "num_GS") if name in stats}
    exact: set[str] = set()
    for name, metric in METRICS.items():
        if metric.unit == "dB" and name in found:
            rows = [row[name] for row in stats["per_view"]]
            if math.inf in rows:
                exact.update(row["view"] for row in stats["per_view"] if row[name] == math.inf)
                found[name] = sum(min(value, MOST_DB) for value in rows) / len(rows)
    return found, len(exact)


@contextlib.contextmanager
def peak_memory(trainer: Trainer, record: RunRecord) -> Iterator[None]:
    """Raise `record.peak_memory` to the peak of this part, less the memory of other runs that take turns."""
    meter = memory_meter(trainer.backend.device)
    if meter is None:
        yield
        return
    moments = (state.values() for optimizer in trainer.optimizers.values() for state in optimizer.state.values())
    held = [*trainer.splats.values(), *itertools.chain(*moments)]
    own = sum(tensor.nbytes for tensor in held if torch.is_tensor(tensor))
    before = meter.reset()
    yield
    record.peak_memory = max(record.peak_memory or 0, meter.peak() - before + own)


@contextlib.contextmanager
def compressed(trainer: Trainer, start: int, iterations: int) -> Iterator[None]:
    """Compress the schedule of the rest of the run into `iterations` iterations from `start` on.

    An iteration has the learning rate and SH degree of a full run at the same share of the way.
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
    """Raise RunDivergedError before the backward of the first loss that is not finite."""
    inner, was_own = trainer.backward, "backward" in vars(trainer)

    def checked(loss: torch.Tensor, view: str, step: int) -> None:
        value = float(loss.detach())
        if not math.isfinite(value):
            raise RunDivergedError(f"loss {value} at iteration {step} on view {view}")
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


@contextlib.contextmanager
def recorded(trainer: Trainer, trace: Trace, gate: SkipGate | None, log: ScalarLog | None) -> Iterator[None]:
    """Add every iteration to the trace and the log, outside the clock."""
    index = {name: i for i, name in enumerate(trainer.view_names)}

    def on_step(iteration: Iteration) -> None:
        trace.fill(iteration.step)
        row = gate.trace[-1] if gate is not None and gate.trace else None
        if row is None or row.step != iteration.step:  # the iteration had no decision
            trace.add(index[iteration.view], iteration.loss, None, REFERENCE, False)
        else:
            trace.add(index[row.view], row.loss, row.mean, row.reason, row.skip)
        if log is not None:
            log.iteration(iteration)

    trainer.on_step = on_step
    try:
        yield
    finally:
        trainer.on_step = None


def point(trainer: Trainer, stats: dict[str, Any], log: ScalarLog | None, seconds: float) -> Point:
    """Return an evaluation with its time in seconds, and write it to the log."""
    if log is not None:
        log.evaluation(stats)
    found, _ = measured(stats)
    metrics = {metric.name: found[metric.name] for metric in chosen()}
    for name, value in metrics.items():
        if not math.isfinite(value):
            raise RunDivergedError(f"held-out {name} {value} after iteration {trainer.step - 1}")
    return Point(trainer.step, seconds, metrics)
