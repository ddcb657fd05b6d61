"""Whole runs in turns, and searches for the setting with which one run matches another."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skipgs_plug import SkipGate
from skipgs_plug.adapters.gsplat_strategy import iterations_that_run, strategy_events
from skipgs_plug.bench.policies import REFERENCE, Earlier
from skipgs_plug.bench.record import RunRecord, Trace
from skipgs_plug.bench.refine import NotRunError, finite_losses, logged, measured, peak_memory, point, recorded
from skipgs_plug.trainer import Trainer
from skipgs_plug.trainer.loop import Iteration
from skipgs_plug.trainer.scalars import ScalarLog

PARTS = 20  # parts of a run, by iteration number; policies take turns by part, and each part ends with an evaluation
SAME_TIME = 0.05  # relative difference of two times that counts as equal
SAME_COUNT = 0.02  # relative difference of two numbers of Gaussians that counts as equal
MOST_TRIES = 5  # tries of a search, at most: each costs a whole run or a densification

Turns = Generator[None, None, None]
Numbers = Callable[[range, Iterable[int], int, int], set[int]]  # arguments: numbers, events, count, seed


@dataclass(frozen=True)
class Maker:
    """Makes trainers of one seed, before their first iteration.

    Attributes:
        create: Makes a trainer with changed settings of training.
        lpips_net: Backbone for LPIPS at the end; None for no LPIPS.
        scalars: Folder for TensorBoard scalars; None for no scalars.
    """

    create: Callable[..., Trainer]
    lpips_net: str | None = None
    scalars: Path | None = None

    def __call__(self, **changes: Any) -> Trainer:
        return self.create(**changes)


def whole_run(trainer: Trainer, gate: SkipGate | None, record: RunRecord, make: Maker) -> Turns:
    """Train to the end in PARTS parts, with a pause after each but the last, and fill the record.

    A search may have trained the trainer for some iterations already. Their points are in the record.

    Raises:
        RunDivergedError: A loss or a metric is not finite.
    """
    with gate or contextlib.nullcontext():
        yield from trained_until(trainer, trainer.max_steps, record, gate, make)


def trained_until(trainer: Trainer, end: int, record: RunRecord, gate: SkipGate | None, make: Maker) -> Turns:
    """Train up to iteration `end` (exclusive), with an evaluation and a pause after each part, but no pause at the end.

    A part ends by a stop request, not by `until`: a gate that leaves out iterations must plan for the whole run.
    """
    if record.trace is None:
        record.trace = Trace(0)
    with finite_losses(trainer), logged(trainer, make.scalars, gate) as log, recorded(trainer, record.trace, gate, log):
        if not record.points:
            record.points.append(point(trainer, trainer.evaluate("test"), log, trainer.t_total))
        for part in range(1, PARTS + 1):
            bound = min(round(part * trainer.max_steps / PARTS), end)
            if bound <= trainer.step:
                continue
            with stopping_at(trainer, bound), peak_memory(trainer, record):
                trainer.train(progress=False)
            if trainer.step >= trainer.max_steps:
                record.trace.fill(trainer.max_steps)
                finish(trainer, gate, record, make.lpips_net, log)
                return
            record.points.append(point(trainer, trainer.evaluate("test"), log, trainer.t_total))
            yield
            if trainer.step >= end:
                break
    record.trace.fill(trainer.step)


@contextlib.contextmanager
def stopping_at(trainer: Trainer, bound: int) -> Iterator[None]:
    """Stop the trainer after the first iteration from `bound - 1` on, unless that is the last iteration of the run."""
    inner = trainer.on_step

    def on_step(iteration: Iteration) -> None:
        if inner is not None:
            inner(iteration)
        if bound - 1 <= iteration.step < trainer.max_steps - 1:
            trainer.stop_requested = True

    trainer.on_step = on_step
    try:
        yield
    finally:
        trainer.on_step = inner


def finish(
    trainer: Trainer, gate: SkipGate | None, record: RunRecord, lpips_net: str | None, log: ScalarLog | None
) -> None:
    """Evaluate, and record the time and memory of the run."""
    stats = trainer.evaluate("test", lpips_net)
    record.points.append(point(trainer, stats, log, trainer.t_total))
    record.metrics, record.exact_views = measured(stats)
    record.train_metrics, _ = measured(trainer.evaluate("train"))
    assert record.trace is not None
    record.iterations = trainer.max_steps
    record.t_post, record.t_total, record.seconds = trainer.t_post, trainer.t_total, trainer.clock.seconds()
    record.phases = dict(trainer.phase_seconds)
    record.iterations_run = record.backwards = sum(record.trace.ran)
    if gate is not None:
        gate.verify()
        report = gate.report()
        record.backwards -= report["backwards_skipped"]
        record.gaussians_shown = report["gaussians_shown"]
        record.reasons = report["reasons"]
        record.floor = report["min_bwd_ratio_effective"]
        growing = report["growing"] or {"share": None, "rate_factor": None}
        record.chosen = {
            "grow_share": growing["share"],
            "grow_rate_factor": growing["rate_factor"],
            "refine_share": report["refine_share"],
        }


def planned(name: str, numbers: Numbers) -> Callable[[Maker, Earlier, RunRecord], Turns]:
    """Return a function that runs as many iterations as policy `name` in each phase; `numbers` chooses them."""

    def run(make: Maker, earlier: Earlier, record: RunRecord) -> Turns:
        trainer, copied = make(), earlier[name].trace
        assert copied is not None
        stop, last = trainer.refine_stop_iter, trainer.max_steps
        kept: set[int] = {last - 1}
        for phase in (range(stop), range(stop, last)):
            ran = sum(copied.ran[phase.start : phase.stop])
            kept |= numbers(phase, [n for n in events(trainer) if n in phase], ran, trainer.config.seed)
        trainer.iterations = lambda until: [n for n in range(trainer.step, until) if n in kept]  # type: ignore
        yield from whole_run(trainer, None, record, make)

    return run


def events(trainer: Trainer) -> set[int]:
    """Return the iterations in which the strategy of a trainer densifies or resets opacities."""
    numbers = range(trainer.max_steps if trainer.mcmc is not None else trainer.refine_stop_iter)
    if trainer.mcmc is not None:
        return set(filter(trainer.mcmc.moves, numbers))
    known = strategy_events(trainer.strategy)
    assert known is not None and known.numbers is not None
    return {*known.numbers(numbers), *iterations_that_run(trainer.strategy, numbers)}


def shortened(
    name: str, gate: Callable[[Trainer, Earlier], SkipGate] | None = None
) -> Callable[[Maker, Earlier, RunRecord], Turns]:
    """Return a function that scales the whole schedule so that it takes as long as policy `name`.

    How long a schedule takes is not proportional to its length: each try is a whole run, from which the next length is
    interpolated. The one whose time is nearest counts.
    """

    def run(make: Maker, earlier: Earlier, record: RunRecord) -> Turns:
        make = dataclasses.replace(make, scalars=None)  # several tries would write to one folder
        full, wanted = earlier[REFERENCE].iterations, earlier[name].t_total
        found: list[RunRecord] = []

        def attempt(length: float) -> Generator[None, None, float]:
            steps = max(1, round(length))
            schedule = make().config.schedule_steps
            changes = {} if schedule is None else {"schedule_steps": max(1, round(schedule * steps / full))}
            trainer = make(max_steps=steps, **changes)
            mine = RunRecord(record.seed, record.policy)
            yield from whole_run(trainer, None if gate is None else gate(trainer, earlier), mine, make)
            found.append(mine)
            return mine.t_total

        first = float(earlier[name].iterations_run)
        tries = yield from search(attempt, first, wanted, SAME_TIME, power=1.0)
        record.tries = [{"max_steps": round(length), "t_total": seconds} for length, seconds in tries]
        take(record, found[nearest(tries, wanted)])

    return run


def as_many_gaussians(name: str) -> Callable[[Maker, Earlier, RunRecord], Turns]:
    """Return a function that runs every iteration, with `grow_grad2d` chosen for as many Gaussians in the end.

    Each try is a densification. The next threshold is interpolated from the tries, in logarithms. The nearest try
    trains to the end of the run.
    """

    def run(make: Maker, earlier: Earlier, record: RunRecord) -> Turns:
        make = dataclasses.replace(make, scalars=None)  # several tries would write to one folder
        own, wanted = earlier[REFERENCE], float(earlier[name].metrics["num_GS"])
        if make().mcmc is not None:
            raise NotRunError("MCMC grows by a share per event, not by grow_grad2d")
        first = make().config.grow_grad2d
        begun: list[tuple[Trainer, RunRecord]] = []

        def attempt(threshold: float) -> Generator[None, None, float]:
            trainer = make(grow_grad2d=threshold)
            mine = RunRecord(record.seed, record.policy)
            yield from trained_until(trainer, trainer.refine_stop_iter, mine, None, make)
            begun.append((trainer, mine))
            return float(trainer.num_gaussians)

        known = [(first, float(own.metrics["num_GS"]))]
        if same(known[0][1], wanted, SAME_COUNT):
            take(record, own)
            record.tries = [{"grow_grad2d": first, "num_GS": known[0][1]}]
            return
        tries = yield from search(attempt, first * known[0][1] / wanted, wanted, SAME_COUNT, power=-1.0, known=known)
        record.tries = [{"grow_grad2d": threshold, "num_GS": count} for threshold, count in tries]
        trainer, mine = begun[nearest(tries[len(known) :], wanted)]
        begun.clear()
        yield from whole_run(trainer, None, mine, make)
        take(record, mine)

    return run


def search(
    attempt: Callable[[float], Generator[None, None, float]],
    first: float,
    wanted: float,
    tolerance: float,
    power: float,
    known: Iterable[tuple[float, float]] = (),
) -> Generator[None, None, list[tuple[float, float]]]:
    """Look for the setting whose result is `wanted`, in at most MOST_TRIES tries.

    Args:
        attempt: Runs with a setting and returns the result, both above 0.
        first: Setting to begin with.
        wanted: Result to reach.
        tolerance: Relative difference to `wanted` that ends the search.
        power: Assumed exponent of the result as a power of the setting, until two results are known.
        known: (setting, result) pairs that are known already.

    Returns:
        (setting, result) of all tries, after `known`.
    """
    tries = list(known)
    setting, most = first, len(tries) + MOST_TRIES
    while True:
        result = yield from attempt(setting)
        tries.append((setting, result))
        if same(result, wanted, tolerance) or len(tries) == most:
            return tries
        setting = next_setting(tries, wanted, power)


def next_setting(tries: list[tuple[float, float]], wanted: float, power: float) -> float:
    """Return the setting at which the line through two tries (in logarithms) meets `wanted`.

    The two tries are the nearest below and the nearest above. If all are on one side, they are the nearest two. A
    single try uses `power` as the slope.
    """
    ranked = sorted(tries, key=lambda one: abs(math.log(one[1] / wanted)))
    below = next((one for one in ranked if one[1] < wanted), None)
    above = next((one for one in ranked if one[1] >= wanted), None)
    (x, y), other = ranked[0], None
    if below is not None and above is not None:
        other = above if below == ranked[0] else below
    elif len(ranked) > 1:
        other = ranked[1]
    if other is not None and other[0] != x and other[1] != y:
        slope = math.log(other[1] / y) / math.log(other[0] / x)
        if slope * power > 0.0:  # noise may reverse the slope of two close tries
            power = slope
    return x * (wanted / y) ** (1.0 / power)


def nearest(tries: list[tuple[float, float]], wanted: float) -> int:
    """Return the index of the try whose result is nearest to `wanted`."""
    return min(range(len(tries)), key=lambda i: abs(math.log(tries[i][1] / wanted)))


def same(result: float, wanted: float, tolerance: float) -> bool:
    """Whether the relative difference of a result to `wanted` is at most `tolerance`."""
    return abs(result / wanted - 1.0) <= tolerance


def take(record: RunRecord, found: RunRecord) -> None:
    """Fill a record with a run that was made for it, or with an identical run."""
    for name in (field.name for field in dataclasses.fields(RunRecord)):
        if name not in ("seed", "policy", "tries"):
            setattr(record, name, getattr(found, name))
