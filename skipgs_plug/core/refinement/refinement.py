"""Refinement in fewer, larger, shrinking steps: what joins the loop's numbers, the learning rates and the foresight."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from typing import Any

from skipgs_plug.core import distributed
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.errors import AdapterMismatchError, SkipGSError
from skipgs_plug.core.refinement.foresight import CYCLE_ENDS, ONE_CYCLE, Foresight, needed_share, watched_views
from skipgs_plug.core.refinement.loop_range import LoopRange, line_of, require_planned
from skipgs_plug.core.refinement.milestones import milestones
from skipgs_plug.core.refinement.rates import ScaledRates, path_factor
from skipgs_plug.core.refinement.thinning import Thinning

log = logging.getLogger(__name__)

SEARCHED = 10  # iterations from the start on, after which the training loop must have been recognised
RECOVERY = 500  # iterations that run after a structural change which comes when refinement has ended

Always = Callable[[range], Iterable[int]]


def nothing_always(numbers: range) -> Iterable[int]:
    """No iteration must run but those that the loop's own conditions name."""
    return ()


class Refinement:
    """Says which iterations of refinement run, and by what factor their learning rates are larger.

    The training loop is the one whose numbers the trainer's iterations follow. Before `start` every number runs.
    Where steps are larger and shrink to nothing, the iterations that run come first: trainers lower the rate of
    positions by number, and an end that comes sooner leaves a finished model sooner. Elsewhere they are spread evenly.

    Args:
        config: With `refine_share`.
        rates: What scales.
        go_on: Loads the state that belongs to what training goes on from with an iteration, if there is one.

    Attributes:
        share: of the iterations that run, or may run where it is found automatically; None before refinement.
        thinning: counts what ran and what was left out.
        foresight: follows the cycles of steps that shrink, one where the share is given; None where rates stay.
        always: numbers that must run, by the reason.
        watched: views that are watched and not trained on while `foresight` says so.
        gap: iterations left out right before the present one.
    """

    def __init__(self, config: SkipConfig, rates: ScaledRates, go_on: Callable[[int], None]) -> None:
        self._config = config
        self._rates = rates
        self._go_on = go_on
        self.share: float | None = None if config.refine_share == "auto" else config.refine_share  # type: ignore[assignment]
        self.thinning = Thinning(1.0)
        self.foresight: Foresight | None = None
        self.always: dict[str, set[int]] = {}
        self.watched: frozenset[str] = frozenset()
        self.gap = self._left_out = 0
        self._start = 0
        self._last: int | None = None
        self._views: list[str] | None = None
        self._keeps_rates = False
        self._hidden: Always = nothing_always
        self._chosen: frozenset[int] = frozenset()
        self._pure: tuple[str, ...] = ()
        self._driver: LoopRange | None = None
        self._loops: list[LoopRange] = []
        self._without_loop = 0
        self._first: int | None = None  # of refinement, and what ends it
        self._must: frozenset[int] = frozenset()
        self._recovery = self._recovered = 0  # iterations to run after a change, and those that have
        self._next: int | None = None  # number that is asked about next, also by the loop of a loaded state
        self._over = False  # what holds for the present iteration
        self._begun = self._removed = False

    # What is known of the trainer.

    def configure(self, start: int, last: int | None, views: list[str] | None, keeps_rates: bool) -> None:
        """Take what is known before the first iteration.

        Args:
            start: First iteration that may be left out.
            last: Last iteration of the run; None where the loop's range says it.
            views: Keys of all training views, when they are known.
            keeps_rates: Leave learning rates alone: the trainer takes as many steps as before.

        Raises:
            SkipGSError: Processes would find different ends.
        """
        self._refuse_several()
        self._start, self._last, self._views, self._keeps_rates = start, last, views, keeps_rates

    def know_views(self, views: list[str]) -> None:
        """Take the keys of all training views."""
        self._views = views

    def describe(self, always: Always = nothing_always, pure: Iterable[str] = ()) -> None:
        """Take what cannot be read off the loop: hidden numbers, and functions that only look at numbers."""
        self._hidden, self._pure = always, tuple(pure)

    def choose(self, always: Iterable[int]) -> None:
        """Take the numbers that the user wants to run beside hidden ones."""
        self._chosen = frozenset(always)

    def remove(self) -> None:
        """Let go of the loop, which runs all its numbers from now on."""
        self._removed = True

    # What the loop asks.

    @property
    def wants_loop(self) -> bool:
        """Whether it is not known yet which loop trains."""
        return self._driver is None

    @property
    def lacks_loop(self) -> bool:
        """Whether iterations are to be left out and no loop runs that could do so: none was given, or it is over."""
        return self.number is None and not self._removed

    @property
    def number(self) -> int | None:
        """Number of the present iteration; None while the loop is not known, and when it is over."""
        return None if self._driver is None else self._driver.current

    def follow(self, loop: LoopRange) -> LoopRange:
        """Take this loop for the one that trains.

        Raises:
            SkipGSError: It goes on after the end that was planned for, or processes would find different ends.
        """
        self._refuse_several()
        if self._begun and self._last is not None:
            require_planned(loop.numbers, self._last)
        self._driver = loop
        return loop

    def heartbeat(self, step: int) -> None:
        """The trainer began iteration `step`.

        Raises:
            AdapterMismatchError: No loop over a range counts the iterations.
        """
        if self._driver is None:
            self._driver = next((loop for loop in self._loops if loop.current == step), None)
            self._loops.clear()
            if self._driver is not None and step >= self._start and self._first is None:
                self._first = step  # it began before its loop was known
                self.thinning.runs(must=True)
        if self._driver is None:
            self._without_loop += step >= self._start
            if self._without_loop == SEARCHED:
                raise AdapterMismatchError(
                    "No loop over range(...) counts the iterations of this trainer, so none can be left out; gate "
                    "without refine_share, or write the loop as: for step in gate.iterations(range(...))."
                )

    def runs(self, loop: LoopRange, number: int) -> bool:
        """Whether the loop runs with this number; asked once for each, in order."""
        if self._removed:
            return True
        if self._driver is None and number == loop.numbers.start > 0:
            self._go_on(number)
        if self._driver is None and number == self._next:
            self._driver = loop  # goes on where the saved state left it
        if loop is not self._driver:
            if self._driver is None and loop not in self._loops:
                self._loops.append(loop)
            return True
        self._next = number + 1
        if number < self._start:
            return True
        if not self._begun:
            self._begin(loop, number)
        self._set_pace()
        must = number in self._must or number == self._last
        if not self.thinning.runs(must):
            self._left_out += 1
            return False
        self.gap, self._left_out = self._left_out, 0
        return True

    def expected(self, loop: LoopRange) -> int:
        """How many numbers the loop will run, as far as is known. Ranges that no loop runs over are never asked."""
        numbers = loop.numbers
        before = len(range(numbers.start, min(max(self._start, numbers.start), numbers.stop)))
        return before + round((len(numbers) - before) * (self.share or 1.0))

    def ended(self, loop: LoopRange) -> None:
        """The loop is over, or was left: whatever steps afterwards is no part of it."""
        if loop is self._driver:
            self._rates.rest()

    # Refinement.

    @property
    def watching(self) -> bool:
        """Whether watched views are left out of training at present."""
        return self.foresight is not None and self.foresight.watching and not self._removed

    @property
    def over(self) -> bool:
        """Whether steps have shrunk to nothing, so that what still runs need not train."""
        return self._over and not self._removed

    def notify_event(self, n_views: int) -> None:
        """A structural change happened; when refinement has ended, the model is given time to recover."""
        if self.foresight is not None and self.foresight.ended:
            pause = self._config.pause_iters
            self._recovery, self._recovered = max(n_views, RECOVERY) if pause is None else pause, 0

    def _begin(self, loop: LoopRange, number: int) -> None:
        if self._first is None:
            self._first = number
        # Of a run that goes on, those behind it too: conditions are judged by how often they hold.
        numbers = range(self._first, loop.numbers.stop)
        self._begun = True
        found = dict(self.always)  # of this loop, where a state is loaded within it
        if loop.source is not None:
            code, names = loop.source
            found = milestones(code, line_of(code), numbers, names, self._pure)
            loop.source = None
        hidden = {n for n in (*self._hidden(numbers), *self._chosen) if n in numbers}
        if hidden:
            found["named for this trainer"] = hidden
        self.always = found
        self._must = frozenset().union(*found.values()) if found else frozenset()
        if self._last is None:
            self._last = loop.numbers[-1]
        total = self._last + 1 - self._first
        if self._auto and self.share is None:
            if self._views is None:
                raise SkipGSError(
                    'refine_share="auto" must know the training views; give their names to gate.iterations() as views='
                    ", or a share."
                )
            self.share = needed_share(total, len(self._views))
        assert self.share is not None
        if self._auto and self._views is not None:
            self.watched = watched_views(self._views, self.share * total)
        if not self._scales:
            if self.foresight is not None:
                raise SkipGSError(
                    "The gate state was saved with larger, shrinking steps, which are off now; go on with compensate "
                    "as it was, or start the gate afresh."
                )
            self.thinning.share = self.share
        elif self.foresight is None:
            self.foresight = Foresight(self._config.tolerance, CYCLE_ENDS if self.watched else ONE_CYCLE)
        log.info(
            "Refinement: at most %.0f %% of iterations %d to %d run, %d of them in any case.",
            100 * (self.share or 1.0),
            self._first,
            self._last,
            len(self._must),
        )

    @property
    def _auto(self) -> bool:
        return self._config.refine_share == "auto"

    @property
    def _scales(self) -> bool:
        if self._keeps_rates or not self._config.compensates:
            return False
        return self._config.rate_peak is not None or (self.share is not None and self.share < 1.0)

    def _refuse_several(self) -> None:
        if self._auto:
            distributed.refuse_several(
                "refine_share='auto' decides by the losses of one process", "give a share, such as 0.4"
            )

    def _set_pace(self) -> None:
        """Set the share and the factor with which the next number is decided on; without larger steps both stay."""
        if self.foresight is None:
            return
        assert self._first is not None and self._last is not None and self.share is not None
        if self._recovered < self._recovery:
            factor = 1.0 - self._recovered / self._recovery
            self._recovered += 1
            self._over = False
        else:
            progress = self.foresight.progress(self.thinning.run / (self.share * (self._last + 1 - self._first)))
            factor = path_factor(self.share, progress, self._config.rate_peak, self._rates.shown.share)
            self._over = self.foresight.ended
        self.thinning.share = 0.0 if self._over else 1.0
        self._rates.scale(factor)

    # State and report.

    def report(self) -> dict[str, Any]:
        """`refine_share`, `gaussians_shown`, `iterations_run`, `iterations_skipped`, and what was foreseen."""
        foresight = self.foresight
        return {
            "refine_share": self.share,
            "gaussians_shown": self._rates.shown.share,
            "iterations_run": self.thinning.run,
            "iterations_skipped": self.thinning.left_out,
            "always_run": {reason: len(numbers) for reason, numbers in self.always.items()},
            "foresight": None
            if foresight is None or not self._auto
            else {
                "ended_early": foresight.early,
                "cycle": foresight.cycle,
                "gains_db": [list(gain) for gain in foresight.gains],
                "rest_worth_db": foresight.foreseen,
                "watched": sorted(self.watched),
            },
        }

    def state_dict(self) -> dict[str, Any]:
        return {
            "asked": self._config.refine_share,
            "share": self.share,
            "first": self._first,
            "next": self._next,
            "thinning": self.thinning.state_dict(),
            "recovery": [self._recovery, self._recovered],
            "foresight": None if self.foresight is None else self.foresight.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        if state["asked"] != self._config.refine_share:
            raise SkipGSError(
                f"The gate state was saved with refine_share={state['asked']!r}, not {self._config.refine_share!r}; "
                "go on with its setting, or start the gate afresh."
            )
        share = state["share"]
        if not (self._auto and state["first"] is None if share is None else 0.0 < share <= 1.0):
            raise SkipGSError(f"The gate state has share={share!r}, which none is; start the gate afresh.")
        self.share, self._first = share, state["first"]
        self.thinning.load_state_dict(state["thinning"])
        self._recovery, self._recovered = state["recovery"]
        if state["foresight"] is not None:
            self.foresight = Foresight(self._config.tolerance)
            self.foresight.load_state_dict(state["foresight"])
        self._next, self._begun = state["next"], False
