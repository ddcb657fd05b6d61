"""The schedule of the growing phase: its events, its opacity resets, and the iterations that must run."""

from __future__ import annotations

from typing import NamedTuple

from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.pace.densification_events import DensificationEvents, sort_conditions
from skipgs_plug.core.pace.needs import last_part, refining_share
from skipgs_plug.core.pace.phase import NAMED_FOR_TRAINER, PhasePlan


class GrowingPlan(NamedTuple):
    """Facts about the growing phase that hold from the beginning of the loop.

    Attributes:
        events: Densification events.
        first: First iteration of the phase.
        end: First iteration after it.
        length: Number of iterations from the first to the end of the events. Prunes and selections after them need no
            further iterations.
        epoch: Number of iterations in which every view comes up once; 0 if unknown.
        always: Iterations that must run, by reason.
        must: Iterations that must run. An event that must run, even if few iterations ran before it, is among them.
        must_shares: Share of the iterations that must run, until the end of the events and after it.
        reset: Iteration of the last opacity reset; None without one, or if it is unknown.
        resets: Whether steps must be as in a phase with opacity resets; see `DensificationEvents.with_resets`.
        whole_from: Iteration from which all run; None if enough refinement follows.
        unrefined: Whether the run ends before it makes up for the growing phase.
        steps_after: Number of iterations that will run in the following phase.
        random_points: Whether the points are random; None if the trainer does not say.
        slow_positions: See `TrainerInfo`.
    """

    events: DensificationEvents
    first: int
    end: int
    length: int
    epoch: int
    always: dict[str, set[int]]
    must: frozenset[int]
    must_shares: tuple[float, float]
    reset: int | None
    resets: bool
    whole_from: int | None
    unrefined: bool
    steps_after: int
    random_points: bool | None
    slow_positions: bool

    @property
    def all_must(self) -> bool:
        """Whether all iterations until the end of the events must run."""
        return self.must_shares[0] >= 1.0

    @property
    def opacities_recover(self) -> bool:
        """Whether opacities must recover, from resets or from MCMC's regulariser."""
        return self.resets or not self.events.resets

    def must_share(self, number: int) -> float:
        """Return the share of the iterations that must run in the part of the phase with iteration `number`."""
        return self.must_shares[number >= self.first + self.length]


def plan_growing(plan: PhasePlan, config: SkipConfig, first: int | None) -> GrowingPlan | None:
    """Return the schedule of the phase; None if it has no densification event.

    Args:
        plan: Facts about the phase, with `densification`.
        config: Settings.
        first: First iteration of the phase; None if it begins with `plan.numbers`.
    """
    numbers, found, densification, named = plan.numbers, plan.conditions, plan.densification, plan.named
    assert densification is not None
    if densification.marks and not any(mark in reason for reason in found for mark in densification.marks):
        return None
    if (plan.accumulates or plan.steps_each) and config.grow_share is None:
        # The trainer's own refinement on accumulated gradients has few steps: 312 of 15,000 iterations in FastGS.
        # Densification is nearly all of the training then, so all of it runs.
        named = set(numbers)
    first = numbers.start if first is None else first
    hits, resets, others = sort_conditions(found, numbers, densification)
    events = DensificationEvents(hits, densification)
    # A condition can name the iteration of an event that is left out. The iteration runs all the same if the
    # condition holds less often than events happen. If it holds as often, such as for a line in a log, it holds
    # again soon.
    rare = [some for some in others.values() if len(some) < len(hits)]
    common = [some for some in others.values() if len(some) >= len(hits)]
    must = frozenset(named).union(resets, *rare, *(some - hits for some in common))
    reset = max(resets, default=None)
    following = plan.last + 1 - numbers.stop
    end = min(numbers.stop, events.end or numbers.stop)
    until, after = (
        len(must.intersection(part)) / max(len(part), 1) for part in (range(first, end), range(end, numbers.stop))
    )
    auto, whole_from = config.growing == "auto", None
    last = last_part(plan.last + 1 - numbers.start, None if reset is None else plan.last - reset)
    grows = reset is not None and end == numbers.stop  # it resets opacities, and its events go on to the end
    unrefined = auto and grows and following < last
    if unrefined or (auto and following <= 0):
        whole_from = max(plan.last + 1 - last, first)
        must |= set(range(whole_from, numbers.stop))
    return GrowingPlan(
        events=events,
        first=first,
        end=numbers.stop,
        length=end - first,
        epoch=plan.epoch or 0,
        always={**others, NAMED_FOR_TRAINER: named} if named else others,
        must=must,
        must_shares=(until, after),
        reset=reset,
        resets=events.with_resets(reset is not None, numbers.stop),
        whole_from=whole_from,
        unrefined=unrefined,
        steps_after=_steps_after(plan, config, following),
        random_points=plan.random_points,
        slow_positions=plan.slow_positions,
    )


def _steps_after(plan: PhasePlan, config: SkipConfig, following: int) -> int:
    """Return how many of the `following` iterations run in refinement."""
    if following <= 0:
        return 0
    asked = config.refining
    if asked == "auto":
        share = refining_share(following, plan.epoch or 0, len(plan.numbers), plan.slow_positions)
    else:
        share = 1.0 if asked is None else float(asked)
    return round(share * following)
