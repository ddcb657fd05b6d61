"""The growing phase: fewer iterations and fewer densification events before refinement begins."""

from __future__ import annotations

import math
from typing import Any

from skipgs_plug.core import distributed
from skipgs_plug.core.caution import caution
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.pace.growing_plan import GrowingPlan, plan_growing
from skipgs_plug.core.pace.growing_steps import longer_steps
from skipgs_plug.core.pace.half_size import HalfSize
from skipgs_plug.core.pace.needs import (
    LAST_FACTOR,
    for_new_gaussians,
    growing_share,
    most_raised,
    opacity_factor,
    opacity_rate,
    share_after_event,
    share_after_reset,
)
from skipgs_plug.core.pace.parts import ONLY_HIGHER_BANDS, UNCHANGED, GrowingParts
from skipgs_plug.core.pace.phase import Phase, PhasePlan
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
        half_size: Photographs of half the size.
    """

    leaves_out = True

    def __init__(self, config: SkipConfig, rates: ScaledRates) -> None:
        self._config = config
        self._rates = rates
        self.share = None if config.growing == "auto" else config.growing  # type: ignore[assignment]
        self.sampling = Sampling(1.0)
        self.half_size = HalfSize(config)
        self._plan: GrowingPlan | None = None
        self._first: int | None = None  # first iteration of the phase, also in a resumed run
        self._must: frozenset[int] = frozenset()  # iterations that must run: those of the plan, and further ones
        self._visible: float | None = None  # share that a view shows, in the first measurement; it settles `share`
        self._visible_now: float | None = None  # that share in the latest measurement
        self._share_now: float | None = None  # share of the present iterations; None for `share`
        self._rows_at_first = 0  # number of Gaussians at the first event
        self._measuring = True
        self._fading = False  # whether the points that the scene began with faded
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
        events_before = self._events_state
        planned = plan_growing(plan, self._config, self._first)
        if planned is None:
            return False
        if events_before is not None:
            planned.events.load_state_dict(events_before)
        self._plan, self._first, self._must = planned, planned.first, planned.must
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
        plan, share = self._plan, self.share
        # Twice their rate in the last 1,000 iterations of a run without refinement did not help on bonsai.
        if plan is None or share is None or not self._has_longer_steps:
            return 0.0
        if plan.reset is None or plan.whole_from is not None:
            return 0.0
        grown = (plan.end - plan.reset) * share * opacity_factor(share)
        return opacity_rate(grown + plan.steps_after)

    @property
    def _has_longer_steps(self) -> bool:
        """Whether iterations are left out until the last event, and longer steps may replace them."""
        return self.share is not None and self.share < 1.0 and not self._all_must and self._config.compensates

    @property
    def _all_must(self) -> bool:
        """Whether all iterations until the last event must run."""
        return self._plan is not None and self._plan.all_must

    def shortened(self, end: int) -> int:
        return 0 if self._first is None or self._all_must else end - self._first

    def is_named(self, number: int) -> bool:
        plan = self._plan
        return plan is None or number in plan.events or any(number in hits for hits in plan.always.values())

    def require(self, number: int) -> None:
        self._must |= {number}

    def end(self) -> None:
        if self._first is not None:
            self._rates.visibility.restart()  # the grown scene decides how long steps are in refinement

    def runs(self, number: int) -> bool:
        plan = self._plan
        assert plan is not None
        self._settle(plan)
        events = plan.events
        event, must, needed = number in events, number in self._must, 0
        if event:
            self._count_gaussians(plan, number)
            if not must:
                needed = self._needed(plan, number)
                must = events.behind >= needed and not self._full(plan)
        self._set_share(plan, number)
        if not self.sampling.runs(must, barred=event and not must):
            if event:
                events.skipped()
            return False
        events.ran(number, needed)
        if event and self._visible is not None and not plan.all_must:
            self._measuring = True
            self._rates.visibility.restart()
        self._set_rates(plan, number)
        return True

    def _set_share(self, plan: GrowingPlan, number: int) -> None:
        """Set the share of the iterations from iteration `number` on."""
        share = self._share_at(plan, number)
        if self._share_now is None and (plan.reset is None or number <= plan.reset):
            self.sampling.share = share  # it never changed, so the iterations before it was settled count, too
        else:
            self.sampling.set_share(share)

    @property
    def _asked(self) -> float:
        """Share of the present iterations that the scene asks for."""
        assert self.share is not None
        return self.share if self._share_now is None else self._share_now

    def _share_at(self, plan: GrowingPlan, number: int) -> float:
        """Return the share that runs around iteration `number`: after a late reset more, so that opacities recover."""
        end = plan.first + plan.length
        if not self._auto or plan.reset is None or not plan.reset < number < end:
            return self._asked
        return max(self._asked, share_after_reset(end - plan.reset))

    def _set_rates(self, plan: GrowingPlan, number: int) -> None:
        """Set the learning rates of an iteration that runs."""
        if plan.reset is not None and number > plan.reset:
            self._rates.opacity_rate = self.opacity_rate
        if plan.whole_from is not None and number >= plan.whole_from:
            # Steps that are longer and shrink, as in refinement, end 0.7 dB lower on bonsai: opacities recover less.
            if self._has_longer_steps:
                self._rates.scale(LAST_FACTOR, ONLY_HIGHER_BANDS)
            else:
                self._rates.look()
            return
        factor, parts = self._factors(plan, number)
        if max(factor, parts.opacities) > 1.0:
            self._rates.scale(factor, parts)
        elif self._measuring or self._config.max_gaussians is not None:
            self._rates.look()
        else:
            self._rates.pause()

    def _count_gaussians(self, plan: GrowingPlan, number: int) -> None:
        """Count the Gaussians at the event in iteration `number`; with "auto" they decide on the present share."""
        events = plan.events
        assert self.share is not None
        events.rows = distributed.largest(self._rates.rows)  # ranks leave out the same events
        bound = self._config.max_gaussians
        if not self._rows_at_first and bound is not None and events.rows > bound:
            caution(
                f"The scene has {events.rows:,} Gaussians before it grows, more than max_gaussians={bound}: it will "
                "not grow, and the gate removes none."
            )
        self._rows_at_first = self._rows_at_first or events.rows
        if self._grows_strongly:  # new Gaussians are small by now, and half the size cost bonsai .0014 SSIM
            self.half_size.end(number)
        if self._auto and self._visible is not None:
            wanted = share_after_event(self.share, events.growth, self.stretch, events.all_run)
            self._share_now = max(self.share, wanted) if self._has_room(plan, number) else self.share

    def _has_room(self, plan: GrowingPlan, number: int) -> bool:
        """Whether more iterations than `share` can run from `number` on, by `most_raised`."""
        assert self.share is not None
        left = plan.length - (number - plan.first)
        most = most_raised(plan.length, self.stretch, plan.slow_positions)
        return self.sampling.run + self.share * left < most * plan.length

    def _needed(self, plan: GrowingPlan, number: int) -> int:
        """Return the number of iterations that must run before the event in iteration `number`."""
        assert self.share is not None
        # The ray-traced scene, which grows to e times as many Gaussians at most, needs more iterations per event with a
        # larger share. Scenes that grow more do not.
        grows_strongly = self._auto and self._grows_strongly
        needed = plan.events.needed(number, self._visible_now, self.share, plan.length, grows_strongly)
        # After a late reset, as many events run as without it: with more, scenes end with 109 instead of 105 %.
        return round(needed * self._share_at(plan, number) / self._asked)

    @property
    def _grows_strongly(self) -> bool:
        """Whether there are more than e times as many Gaussians as at the first event."""
        return self.stretch > 1.0

    @property
    def _auto(self) -> bool:
        return self._config.growing == "auto"

    def _settle(self, plan: GrowingPlan) -> None:
        """Use the present measurement; the share of the phase is fixed once enough steps are measured."""
        visibility, settled = self._rates.visibility, self._visible is not None
        if self._measuring and visibility.steps >= (MEASURED_AGAIN if settled else MEASURED):
            self._visible_now, self._measuring = visibility.visible, False
        if not self._measuring:
            visibility.finish()
        if settled:
            return
        events = plan.events
        self._visible = self._visible_now
        if self._visible is not None:
            # Where opacities are never reset, as in MCMC, a regulariser lets all of them fall.
            told = plan.random_points is False or not events.resets
            self._fading = self._rates.fading.finish() and not told
            if self._fading and not self._auto:
                self._warn_of_fading(plan)
        if self._auto:
            longer = self._config.compensates and self._visible is not None
            all_run = len(events) if events.all_run else 0
            shown, moved = self._visible if self._fading or plan.random_points else None, not events.resets
            self.share = growing_share(plan.length, plan.epoch, longer, all_run, shown, plan.opacities_recover, moved)

    def _warn_of_fading(self, plan: GrowingPlan) -> None:
        """Warn if the share that the user gave is too small for a scene of random points."""
        assert self.share is not None
        enough = growing_share(plan.length, plan.epoch, longer=True, shown_of_random=self._visible)
        if self._has_longer_steps and self.share < enough:
            caution(
                f"The points that the scene began with fade, as random ones do. With a share of {self.share:g}, "
                f"{self.share * plan.length:,.0f} iterations run until densification ends, and such points can stay "
                f'as haze: give grow_share={math.ceil(100 * enough) / 100:g} or "auto".'
            )

    def _factors(self, plan: GrowingPlan, number: int) -> tuple[float, GrowingParts]:
        """Return the factor on learning rates in iteration `number`, and how kinds of parameters share in it."""
        if self.share is None or self._visible is None or not self._config.compensates:
            return 1.0, UNCHANGED
        share = max(self._share_now or self.share, plan.must_share(number))
        return longer_steps(plan, share, self._visible, self._times_grown, self._fading)

    @property
    def _times_grown(self) -> float | None:
        """Present number of Gaussians, as a multiple of those at the first event; None if unknown."""
        return None if self._plan is None or not self._rows_at_first else self._plan.events.rows / self._rows_at_first

    def _full(self, plan: GrowingPlan) -> bool:
        """Whether one more event could exceed the number of Gaussians that the user allows."""
        bound, events = self._config.max_gaussians, plan.events
        return bound is not None and events.rows + events.grown > bound

    def report(self) -> dict[str, Any] | None:
        """Return the entries of skipgs.json about this phase; None if it has not begun.

        `share`, `iterations_run`, `iterations_skipped`, `events_run`, `events_skipped`, `rate_factor`,
        `opacity_rate_factor`, `times_grown` (Gaussians at the last event, as a multiple of those at the first; None if
        unknown), `fading` (whether the points that the scene began with faded), `random_points` (whether they did, or
        the trainer said so), those of `HalfSize.report`, and `always_run`.
        """
        plan = self._plan
        if plan is None:
            return None
        events = plan.events
        known = self.share is not None and self._config.compensates
        factor, parts = self._factors(plan, plan.first) if known else (None, None)
        return {
            "share": self.share,
            "iterations_run": self.sampling.run,
            "iterations_skipped": self.sampling.left_out,
            "events_run": events.kept,
            "events_skipped": events.left_out,
            "rate_factor": factor,
            "opacity_rate_factor": None if parts is None else parts.opacities,
            "times_grown": self._times_grown,
            "fading": self._fading,
            "random_points": self._fading or bool(plan.random_points),
            **self.half_size.report(),
            "always_run": {reason: len(numbers) for reason, numbers in plan.always.items()},
        }

    @property
    def _events_state(self) -> dict[str, Any] | None:
        return self._saved_events if self._plan is None else self._plan.events.state_dict()

    def state_dict(self) -> dict[str, Any] | None:
        if self._first is None:
            return None
        return {
            "asked": self._config.growing,
            "share": self.share,
            "first": self._first,
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
        self._measuring, self._fading = state["measuring"], state.get("fading", False)
        self._share_now, self._rows_at_first = state.get("share_now"), state.get("gaussians_at_first", 0)
        self._visible, self._visible_now = state["gaussians_shown"]
        if self._visible is not None:
            self._rates.fading.stop()
        self.half_size.load_state_dict(state.get("half_size", [0, None]))  # an older run has no such photographs
        self.sampling.load_state_dict(state["sampling"])
        self._saved_events, self._plan = state["events"], None
