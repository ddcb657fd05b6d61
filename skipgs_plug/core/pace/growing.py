"""The growing phase: fewer iterations and fewer densification events before refinement begins."""

from __future__ import annotations

import math
from typing import Any

from skipgs_plug.core import distributed
from skipgs_plug.core.caution import caution
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.pace.densification_events import DensificationEvents, sort_conditions
from skipgs_plug.core.pace.half_size import HalfSize
from skipgs_plug.core.pace.needs import (
    HIGHEST_OPACITY_RATE,
    LAST_FACTOR,
    LEAST_GROWING_SHARE,
    LONGEST_STEPS_OF_POSITIONS,
    LONGEST_STEPS_OF_POSITIONS_THAT_STAY,
    LONGEST_STEPS_OF_SCALES,
    MOST_RAISED_SHARE,
    SELDOM_SHOWN,
    for_new_gaussians,
    geometry_part,
    growing_factor,
    growing_share,
    last_part,
    opacity_factor,
    opacity_rate,
    refining_share,
    share_factor,
)
from skipgs_plug.core.pace.parts import GEOMETRY, ONLY_HIGHER_BANDS, UNCHANGED, GrowingParts
from skipgs_plug.core.pace.phase import NAMED_FOR_TRAINER, Phase, PhasePlan
from skipgs_plug.core.pace.rates import ScaledRates
from skipgs_plug.core.pace.sampling import Sampling

# Number of steps over which the share of the Gaussians that a view shows is averaged before it decides on shares, so
# that a single view does not decide.
MEASURED = 20
# Number of these steps after each event that ran. The share falls as the scene grows, on bonsai from 46 % to 30 %. A
# few steps are precise enough to count visits, and each measured step can cost a read of the GPU.
MEASURED_AGAIN = 8


class Growing(Phase):
    """Decides which iterations run while the scene grows, and scales learning rates if that replaces iterations.

    The iterations that run are spread evenly. With "auto", more of them run after an event that added many Gaussians.
    A densification event runs if enough iterations ran before it. The iteration of any other event is left out, so that
    its statistics go on to the following event. Everything else that depends on the iteration's number happens as in
    the trainer's own run.

    Args:
        config: Settings with `growing`.
        rates: Scales learning rates, and measures the share of the Gaussians that a view shows.

    Attributes:
        sampling: Counts the iterations that ran and that were left out.
        events: Densification events; None before the phase begins.
        half_size: Photographs of half the size.
        always: Iterations that must run, by reason.
    """

    leaves_out = True

    def __init__(self, config: SkipConfig, rates: ScaledRates) -> None:
        self._config = config
        self._rates = rates
        self.share = None if config.growing == "auto" else config.growing  # type: ignore[assignment]
        self.sampling = Sampling(1.0)
        self.events: DensificationEvents | None = None
        self.always: dict[str, set[int]] = {}
        self._must: frozenset[int] = frozenset()
        self._must_shares = 1.0, 1.0  # share of the iterations that must run: until the last event, and after it
        self._first: int | None = None
        self._length = 0
        self._epoch = 0
        self._visible: float | None = None  # share that a view shows, in the first measurement; it settles `share`
        self._visible_now: float | None = None  # that share in the latest measurement
        self._share_now: float | None = None  # share of the present iterations; None for `share`
        self._rows_at_first = 0  # number of Gaussians at the first event
        self._measuring = True
        self.half_size = HalfSize(config)
        self._fading = False  # whether the points that the scene began with faded
        self._told_random = False  # whether the trainer says that they are random
        self._reset: int | None = None  # iteration of the last opacity reset; None without one, or if it is unknown
        self._resets = True  # whether opacities are reset in this phase, or it is not known
        self._whole_from: int | None = None  # iteration from which all run, if no or hardly any refinement follows
        self._unrefined = False  # whether the run ends before it makes up for the growing phase
        self._end = self._steps_after = 0  # end of the phase, and number of iterations that will run in the following
        self._saved_events: dict[str, Any] | None = None

    def numbers(self, number: int, end: int) -> range:
        return range(number if self._first is None else self._first, end)

    def begin(self, plan: PhasePlan) -> bool:
        """Receive the facts that are known when a loop begins; return False if it has no densification event.

        Raises:
            SkipGSError: "auto" needs the number of views, and it is unknown.
        """
        if self.share is None:
            plan.epoch_for("share")  # refuses a run of unknown views here, before `_settle` needs their number
        numbers, found, densification, named = plan.numbers, plan.conditions, plan.densification, plan.named
        assert densification is not None
        if (plan.accumulates or plan.steps_each) and self._config.grow_share is None:
            # The trainer's own refinement on accumulated gradients has few steps: 312 of 15,000 iterations in FastGS.
            # Densification is nearly all of the training then, so all of it runs.
            named = set(numbers)
        events, resets, others = sort_conditions(found, numbers, densification)
        before, self.events = self._events_state, DensificationEvents(events, densification)
        if before is not None:
            self.events.load_state_dict(before)
        if densification.marks and not any(mark in reason for reason in found for mark in densification.marks):
            return False
        self.always = {**others, NAMED_FOR_TRAINER: named} if named else others
        # A condition can name the iteration of an event that is left out. The iteration runs all the same if the
        # condition holds less often than events happen. If it holds as often, such as for a line in a log, it holds
        # again soon.
        rare = [hits for hits in others.values() if len(hits) < len(events)]
        common = [hits for hits in others.values() if len(hits) >= len(events)]
        self._must = frozenset(named).union(resets, *rare, *(hits - events for hits in common))
        if self._first is None:
            self._first = numbers.start
        self._reset, self._end = max(resets, default=None), numbers.stop
        self._resets = self.events.with_resets(self._reset is not None, numbers.stop)
        following = plan.last + 1 - numbers.stop
        if following > 0:
            asked = self._config.refining
            if asked == "auto":
                share = refining_share(following, plan.epoch or 0, len(numbers), plan.slow_positions)
            else:
                share = 1.0 if asked is None else float(asked)
            self._steps_after = round(share * following)
        # Prunes and selections after the last event need no further iterations.
        self._length = min(numbers.stop, self.events.end or numbers.stop) - self._first
        end = self._first + self._length
        parts = range(self._first, end), range(end, numbers.stop)
        until, after = (len(self._must.intersection(part)) / max(len(part), 1) for part in parts)
        self._must_shares = until, after
        last = last_part(plan.last + 1 - numbers.start, None if self._reset is None else plan.last - self._reset)
        grows = self._reset is not None and end == numbers.stop  # it resets opacities, and its events go on to the end
        self._unrefined = self._auto and grows and following < last
        if self._unrefined or (self._auto and following <= 0):
            self._whole_from = max(plan.last + 1 - last, self._first)
            self._must |= set(range(self._whole_from, numbers.stop))
        self._epoch, self._told_random = plan.epoch or self._epoch, plan.random_points
        self.half_size.begin(plan)
        return True

    def at_half_size(self, number: int) -> bool:
        return self.half_size.holds(number)

    @property
    def stretch(self) -> float:
        """Factor on the share of the iterations for Gaussians that were added, also in refinement; at least 1."""
        return 1.0 if self._all_must else for_new_gaussians(self._times_grown)

    @property
    def opacity_rate(self) -> float:
        share = self.share
        # Twice their rate in the last 1,000 iterations of a run without refinement did not help on bonsai.
        if share is None or not self._has_longer_steps or self._reset is None or self._whole_from is not None:
            return 0.0
        grown = (self._end - self._reset) * share * opacity_factor(share)
        return opacity_rate(grown + self._steps_after)

    @property
    def _has_longer_steps(self) -> bool:
        """Whether iterations are left out until the last event, and longer steps may replace them."""
        return self.share is not None and self.share < 1.0 and not self._all_must and self._config.compensates

    @property
    def _all_must(self) -> bool:
        """Whether all iterations until the last event must run."""
        return self._must_shares[0] >= 1.0

    def shortened(self, end: int) -> int:
        return 0 if self._first is None or self._all_must else end - self._first

    def is_named(self, number: int) -> bool:
        return self.events is None or number in self.events or any(number in hits for hits in self.always.values())

    def require(self, number: int) -> None:
        self._must |= {number}

    def end(self) -> None:
        if self._first is not None:
            self._rates.visibility.restart()  # the grown scene decides how long steps are in refinement

    def runs(self, number: int) -> bool:
        events = self.events
        assert events is not None
        self._settle()
        event, must, needed = number in events, number in self._must, 0
        if event:
            self._count_gaussians(number)
            if not must:
                needed = self._needed(number)
                must = events.behind >= needed and not self._full()
        if self._share_now is None:
            assert self.share is not None
            self.sampling.share = self.share
        else:
            self.sampling.set_share(self._share_now)
        if not self.sampling.runs(must, barred=event and not must):
            if event:
                events.skipped()
            return False
        events.ran(number, needed)
        if event and self._visible is not None and not self._all_must:
            self._measuring = True
            self._rates.visibility.restart()
        if self._reset is not None and number > self._reset:
            self._rates.opacity_rate = self.opacity_rate
        if self._whole_from is not None and number >= self._whole_from:
            # Steps that are longer and shrink, as in refinement, end 0.7 dB lower on bonsai: opacities recover less.
            if self._has_longer_steps:
                self._rates.scale(LAST_FACTOR, ONLY_HIGHER_BANDS)
            else:
                self._rates.look()
            return True
        factor, parts = self._factors(number)
        if max(factor, parts.opacities) > 1.0:
            self._rates.scale(factor, parts)
        elif self._measuring or self._config.max_gaussians is not None:
            self._rates.look()
        else:
            self._rates.pause()
        return True

    def _count_gaussians(self, number: int) -> None:
        """Count the Gaussians at the event in iteration `number`; with "auto" they decide on the present share."""
        events = self.events
        assert events is not None and self.share is not None
        events.rows = distributed.largest(self._rates.rows)  # ranks leave out the same events
        self._rows_at_first = self._rows_at_first or events.rows
        if self._grows_strongly:  # new Gaussians are small by now, and half the size cost bonsai .0014 SSIM
            self.half_size.end(number)
        if self._auto and self._visible is not None:
            wanted = min(1.0, LEAST_GROWING_SHARE * share_factor(events.growth) * self.stretch)
            self._share_now = max(self.share, wanted) if self._has_room(number) else self.share

    def _has_room(self, number: int) -> bool:
        """Whether more iterations than `share` can run from `number` on, by `MOST_RAISED_SHARE` of the phase."""
        assert self.share is not None and self._first is not None
        left = self._length - (number - self._first)
        return self.sampling.run + self.share * left < MOST_RAISED_SHARE * self._length

    def _needed(self, number: int) -> int:
        """Return the number of iterations that must run before the event in iteration `number`."""
        assert self.events is not None and self.share is not None
        # The ray-traced scene, which grows to e times as many Gaussians at most, needs more iterations per event with a
        # larger share. Scenes that grow more do not.
        grows_strongly = self._auto and self._grows_strongly
        return self.events.needed(number, self._visible_now, self.share, self._length, grows_strongly)

    @property
    def _grows_strongly(self) -> bool:
        """Whether there are more than e times as many Gaussians as at the first event."""
        return self.stretch > 1.0

    @property
    def _auto(self) -> bool:
        return self._config.growing == "auto"

    def _settle(self) -> None:
        """Use the present measurement; the share of the phase is fixed once enough steps are measured."""
        assert self.events is not None
        visibility, settled = self._rates.visibility, self._visible is not None
        if self._measuring and visibility.steps >= (MEASURED_AGAIN if settled else MEASURED):
            self._visible_now, self._measuring = visibility.visible, False
        if not self._measuring:
            visibility.finish()
        if settled:
            return
        self._visible = self._visible_now
        if self._visible is not None:
            # Where opacities are never reset, as in MCMC, a regulariser lets all of them fall.
            self._fading = self._rates.fading.finish() and self.events.resets
            if self._fading and not self._auto:
                self._warn_of_fading()
        if self._auto:
            longer = self._config.compensates and self._visible is not None
            events = len(self.events) if self.events.all_run else 0
            shown, moved = self._visible if self._fading or self._told_random else None, not self.events.resets
            self.share = growing_share(self._length, self._epoch, longer, events, shown, self._opacities_recover, moved)

    def _warn_of_fading(self) -> None:
        """Warn if the share that the user gave is too small for a scene of random points."""
        assert self.share is not None
        enough = growing_share(self._length, self._epoch, longer=True, shown_of_random=self._visible)
        if self._has_longer_steps and self.share < enough:
            caution(
                f"The points that the scene began with fade, as random ones do. With a share of {self.share:g}, "
                f"{self.share * self._length:,.0f} iterations run until densification ends, and such points can stay "
                f'as haze: give grow_share={math.ceil(100 * enough) / 100:g} or "auto".'
            )

    def _factors(self, number: int) -> tuple[float, GrowingParts]:
        """Return the factor on learning rates in iteration `number`, and the parts of opacities and positions."""
        events = self.events
        if self.share is None or self._visible is None or events is None or not self._config.compensates:
            return 1.0, UNCHANGED
        assert self._first is not None
        ends = number >= self._first + self._length  # whether only prunes and terms of the loss follow
        share = max(self._share_now or self.share, self._must_shares[ends])
        grown, refined = self._times_grown, not self._unrefined
        factor = growing_factor(self._length, share, self._visible, events.all_run, grown, self._resets, refined)
        opacities = opacity_factor(share) if self._fading or self._opacities_recover else 1.0
        if self._fading and self._reset is None:
            # A reset takes random points away. Without one, long steps would make them large, and they would stay.
            return factor, GrowingParts(opacities, 1.0, 0.0, events.clears_moments)
        scales = GEOMETRY if self._reset is None else geometry_part(factor, LONGEST_STEPS_OF_SCALES)
        far = (self._reset is not None and not self._fading) or not events.resets
        positions = geometry_part(factor, LONGEST_STEPS_OF_POSITIONS if far else LONGEST_STEPS_OF_POSITIONS_THAT_STAY)
        if self._unrefined and not self._fading and not self._steps_after:
            return factor, GrowingParts(opacities, positions, scales, True, HIGHEST_OPACITY_RATE)
        remember = self._told_random and not events.resets and self._visible < SELDOM_SHOWN
        return factor, GrowingParts(opacities, positions, scales, events.clears_moments, all_remember=remember)

    @property
    def _opacities_recover(self) -> bool:
        """Whether opacities must recover, from resets or from MCMC's regulariser."""
        return self._resets or (self.events is not None and not self.events.resets)

    @property
    def _times_grown(self) -> float | None:
        """Present number of Gaussians, as a multiple of those at the first event; None if unknown."""
        return None if self.events is None or not self._rows_at_first else self.events.rows / self._rows_at_first

    def _full(self) -> bool:
        """Whether one more event could exceed the number of Gaussians that the user allows."""
        bound, events = self._config.max_gaussians, self.events
        return bound is not None and events is not None and events.rows + events.grown > bound

    def report(self) -> dict[str, Any] | None:
        """Return the entries of skipgs.json about this phase; None if it has not begun.

        `share`, `iterations_run`, `iterations_skipped`, `events_run`, `events_skipped`, `rate_factor`,
        `opacity_rate_factor`, `times_grown` (Gaussians at the last event, as a multiple of those at the first; None if
        unknown), `fading` (whether the points that the scene began with faded), `random_points` (whether they did, or
        the trainer said so), those of `HalfSize.report`, and `always_run`.
        """
        if self._first is None:
            return None
        events = self.events
        known = self.share is not None and self._config.compensates
        factor, parts = self._factors(self._first) if known else (None, None)
        return {
            "share": self.share,
            "iterations_run": self.sampling.run,
            "iterations_skipped": self.sampling.left_out,
            "events_run": 0 if events is None else events.kept,
            "events_skipped": 0 if events is None else events.left_out,
            "rate_factor": factor,
            "opacity_rate_factor": None if parts is None else parts.opacities,
            "times_grown": self._times_grown,
            "fading": self._fading,
            "random_points": self._fading or self._told_random,
            **self.half_size.report(),
            "always_run": {reason: len(numbers) for reason, numbers in self.always.items()},
        }

    @property
    def _events_state(self) -> dict[str, Any] | None:
        return self._saved_events if self.events is None else self.events.state_dict()

    def state_dict(self) -> dict[str, Any] | None:
        if self._first is None:
            return None
        return {
            "asked": self._config.growing,
            "share": self.share,
            "first": self._first,
            "views": self._epoch,
            "must_shares": list(self._must_shares),
            "gaussians_shown": [self._visible, self._visible_now],
            "share_now": self._share_now,
            "gaussians_at_first": self._rows_at_first,
            "measuring": self._measuring,
            "fading": self._fading,
            "half_size": self.half_size.state_dict(),
            "sampling": self.sampling.state_dict(),
            "events": self._events_state,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.share, self._first = state["share"], state["first"]
        self._must_shares = state.get("must_shares", (1.0, 1.0))
        self._epoch = state["views"]
        self._measuring, self._fading = state["measuring"], state.get("fading", False)
        self._share_now, self._rows_at_first = state.get("share_now"), state.get("gaussians_at_first", 0)
        self._visible, self._visible_now = state["gaussians_shown"]
        if self._visible is not None:
            self._rates.fading.stop()
        self.half_size.load_state_dict(state.get("half_size", [0, None]))  # an older run has no such photographs
        self.sampling.load_state_dict(state["sampling"])
        self._saved_events, self.events = state["events"], None
