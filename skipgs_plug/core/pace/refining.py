"""The refining phase: fewer, larger, shrinking steps after densification."""

from __future__ import annotations

import logging
import math
from typing import Any

from skipgs_plug.core import distributed
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.errors import GateStateError
from skipgs_plug.core.pace.early_stopping import CYCLE_ENDS, ONE_CYCLE, EarlyStopping, watched_views, why_none_watched
from skipgs_plug.core.pace.needs import longest_positions, most_raised, raised_share, refining_share
from skipgs_plug.core.pace.phase import NAMED_FOR_TRAINER, Phase, PhasePlan
from skipgs_plug.core.pace.rates import ScaledRates, path_factor
from skipgs_plug.core.pace.recovery import Recovery
from skipgs_plug.core.pace.sampling import Sampling

log = logging.getLogger(__name__)

# Reasons for which iterations run.
OF_SHARE, OF_LOOP, OF_CHANGES = "share", "conditions", "changes"


class Refining(Phase):
    """Decides which iterations of refinement run, and the factor on their learning rates.

    If steps are larger and shrink to zero, the iterations that run come first: trainers lower the rate of positions by
    the iteration's number, and a model that is finished early can be used early. Otherwise they are spread evenly.

    Args:
        config: Settings with `refining`.
        rates: Scales learning rates.

    Attributes:
        sampling: Counts the iterations that ran and that were left out.
        stopping: Follows the cycles of shrinking steps, of which a given share has one; None if rates stay as they are.
        always: Iterations that must run, by reason.
        ran_for: Number of iterations that ran, by reason: the share, conditions of the loop after the share was used
            up, or structural changes after that.
        watched: Views that are watched and not trained on while `watching` is True.
    """

    leaves_out = True

    def __init__(self, config: SkipConfig, rates: ScaledRates) -> None:
        self._config = config
        self._rates = rates
        self.share = None if self._auto else config.refining  # type: ignore[assignment]
        self.sampling = Sampling(1.0)
        self.stopping: EarlyStopping | None = None
        self.always: dict[str, set[int]] = {}
        self.watched: frozenset[str] = frozenset()
        self._why_none_watched: str | None = None
        self._first: int | None = None
        self._last: int | None = None
        self._must: frozenset[int] = frozenset()
        self.ran_for = {OF_SHARE: 0, OF_LOOP: 0, OF_CHANGES: 0}
        self._recovery = Recovery()
        self._over = False  # whether refinement has ended, for the present iteration
        self._steps_each = False
        self._shrinks = False  # whether the steps, as many as in the trainer's own run, shrink with its schedule
        self._before = Phase()
        self._grown_by_few = False
        self._first_positions_rate, self._slow_positions = 0.0, False  # see `TrainerInfo`
        self._epoch: int | None = None
        self._begun = self._entered = self._removed = False

    @property
    def begun(self) -> bool:
        """Whether the training loop has begun, so that the last iteration is settled."""
        return self._begun

    def numbers(self, number: int, end: int) -> range:
        return range(number if self._first is None else self._first, end)

    def begin(self, plan: PhasePlan) -> bool:
        """Receive the facts that are known when the loop begins.

        If gradients accumulate, the trainer takes as many steps as in its own run, each with fewer gradients. Steps
        become longer and shrink with its schedule then. So do the steps of a trainer that would accumulate, but steps
        in each iteration that runs: FastGS prunes four times meanwhile, and must train between its prunes.

        Raises:
            SkipGSError: "auto" needs the views and they are unknown, or a loaded state had larger steps and they are
                off now.
        """
        if self._first is None:
            self._first = plan.numbers.start
        grown = plan.before.shortened(self._first)
        self._begun, self._last, self._before, self._grown_by_few = True, plan.last, plan.before, grown > 0
        self._first_positions_rate, self._epoch = plan.positions_rate, plan.epoch
        self._slow_positions = plan.slow_positions
        reasons = {**plan.conditions, NAMED_FOR_TRAINER: plan.named}
        self.always = {reason: hits for reason, hits in reasons.items() if hits}
        self._must = frozenset().union(*self.always.values())
        total = plan.last + 1 - self._first
        if self._auto and self.share is None:
            self.share = refining_share(total, plan.epoch_for("refine_share"), grown, plan.slow_positions)
        assert self.share is not None
        if self._judges:
            self._why_none_watched = self._unwatchable(plan, self.share * total)
            if plan.views is not None and self._why_none_watched is None and self.stopping is None:
                self.watched = watched_views(plan.views, self.share * total)
        # Iterations are spread evenly if gradients accumulate, so that each step gets some.
        spread = plan.accumulates or plan.steps_each
        scales = self._scales
        self._shrinks, self._steps_each = scales and spread, plan.steps_each
        if not scales or spread:
            if self.stopping is not None:
                raise GateStateError(
                    "The gate state was saved with larger, shrinking steps, which are off now; continue with the same "
                    "compensate setting, or start the gate afresh."
                )
            self.sampling.share = self.share
        elif self.stopping is None:
            self.stopping = EarlyStopping(self._config.tolerance, CYCLE_ENDS if self.watched else ONE_CYCLE)
        log.info(
            "Refinement: at most %.0f %% of iterations %d to %d run, %d of them in any case.",
            100 * self.share,
            self._first,
            plan.last,
            len(self._must),
        )
        return True

    def _enter(self) -> None:
        """Begin with the first iteration of the phase: raise the share of "auto" for Gaussians that were added."""
        self._entered = True
        if self.sampling.asked > 0:
            return  # the run was resumed inside the phase
        self._before.end()
        assert self.share is not None
        if self._auto:
            assert self._first is not None and self._last is not None
            stretch = self._before.stretch
            most = most_raised(self._last + 1 - self._first, stretch, self._slow_positions)
            self.share = raised_share(self.share, self.share * stretch, most)
            if self.stopping is None:
                self.sampling.share = self.share

    def runs(self, number: int) -> bool:
        if not self._entered:
            self._enter()
            self._rates.opacity_rate = self._before.opacity_rate
            self._rates.positions_rate = self._positions_rate
        if self.stopping is not None and self._last is not None:
            self._recovery.arrive(number, self._last, self.stopping.ended)
        self._set_pace(number)
        recovers = self._recovery.goes_on
        runs = self.sampling.runs(number in self._must or number == self._last)
        if runs and recovers:
            self._recovery.count()
            self.ran_for[OF_CHANGES] += 1
        elif runs:
            of_share = not self._over and self.ran_for[OF_SHARE] < self.sampling.due
            self.ran_for[OF_SHARE if of_share else OF_LOOP] += 1
        return runs

    def is_named(self, number: int) -> bool:
        return any(number in hits for hits in self.always.values())

    def require(self, number: int) -> None:
        self._must |= {number}

    def count_first(self, number: int) -> None:
        """Count iteration `number`, the first of the phase, if it began before the training loop was known."""
        if self._first is not None:
            return
        self._first = number
        self.sampling.runs(must=True)
        self.ran_for[OF_SHARE] += 1

    def remove(self) -> None:
        """Stop watching views, and train in every iteration."""
        self._removed = True

    @property
    def watching(self) -> bool:
        """Whether watched views are left out of training at present."""
        return self.stopping is not None and self.stopping.watching and not self._removed

    @property
    def over(self) -> bool:
        """Whether steps have shrunk to zero, so that iterations that still run need not train."""
        return self._over and not self._removed

    def notify_event(self, step: int, n_views: int) -> None:
        """Take note of a structural change in iteration `step`, of a run with `n_views` views; see `Recovery`."""
        if self.stopping is None:
            return
        assert self._last is not None and self.share is not None
        pause, ran = self._config.pause_iters, self.sampling.run
        self._recovery.change(step, self._last, self.share, n_views, pause, ran, self.stopping.ended)

    @property
    def _positions_rate(self) -> float:
        """Largest learning rate that positions may take."""
        if not self._first_positions_rate:
            return math.inf
        assert self.share is not None and self._first is not None and self._last is not None
        run = self.share * (self._last + 1 - self._first)
        return longest_positions(run / self._epoch if self._epoch else None) * self._first_positions_rate

    @property
    def _auto(self) -> bool:
        return self._config.refining == "auto"

    @property
    def _judges(self) -> bool:
        """Whether refinement may end before its share has run.

        It may not after a growing phase of few iterations. It never gained so little then that it could end, and
        watching views costs bonsai 0.08 dB.
        """
        return self._auto and not self._grown_by_few

    @staticmethod
    def _unwatchable(plan: PhasePlan, iterations: float) -> str | None:
        """Return why no view can be watched, as a clause; None if views can be watched."""
        if distributed.group_size() > 1:  # they train on different views at a time, so none can be kept out of training
            return "several processes train"
        if plan.views is None:
            return "the trainer does not tell its training views"
        return why_none_watched(len(plan.views), iterations)

    @property
    def _scales(self) -> bool:
        """Whether learning rates change."""
        if not self._config.compensates:
            return False
        return self._config.rate_peak is not None or (self.share is not None and self.share < 1.0)

    def _set_pace(self, number: int) -> None:
        """Set the share and the factor for iteration `number`; without larger steps both stay."""
        assert self._first is not None and self._last is not None and self.share is not None
        if self.stopping is None:
            if self._shrinks:
                progress = (number - self._first) / (self._last + 1 - self._first)
                share, visible = self.share, self._rates.visibility.visible
                if not self._steps_each:
                    self._rates.visibility.finish()  # gradients of several views come together
                    # With a share of its gradients a step is noisier by 1 / sqrt(share). Adam shortens the part that
                    # views agree on by as much.
                    share, visible = math.sqrt(share), None
                self._rates.scale(path_factor(share, progress, self._config.rate_peak, visible))
            return
        if not self._recovery.goes_on:
            steps = self.share * (self._last + 1 - self._first)
            progress, visible = self.stopping.progress(self.sampling.run / steps), self._rates.visibility.visible
            factor = path_factor(self.share, progress, self._config.rate_peak, visible, steps)
            self._over = self.stopping.ended
            if self._over:
                self._recovery.after_refinement(self.sampling.run, self._last)
        if self._recovery.goes_on:
            factor, self._over = self._recovery.factor, False
        self.sampling.share = 0.0 if self._over else 1.0
        self._rates.scale(factor)

    def report(self) -> dict[str, Any]:
        """Return the entries of skipgs.json about this phase.

        `refine_share`, `iterations_run`, `iterations_skipped`, `ran_for` (iterations that ran, by their reason),
        `always_run`, `early_stopping`.
        """
        stopping = self.stopping
        return {
            "refine_share": self.share,
            "iterations_run": self.sampling.run,
            "iterations_skipped": self.sampling.left_out,
            "ran_for": dict(self.ran_for),
            "always_run": {reason: len(numbers) for reason, numbers in self.always.items()},
            "early_stopping": None
            if stopping is None or not self._judges
            else {
                "ended_early": stopping.early,
                "cycle": stopping.cycle,
                "gains_db": [list(gain) for gain in stopping.gains],
                "rest_worth_db": stopping.gain_left,
                "watched": sorted(self.watched),
                "why_none_watched": self._why_none_watched,
            },
        }

    def state_dict(self) -> dict[str, Any]:
        return {
            "asked": self._config.refining,
            "share": self.share,
            "first": self._first,
            "sampling": self.sampling.state_dict(),
            "watched": sorted(self.watched),
            **self._recovery.state_dict(),
            "ran_for": dict(self.ran_for),
            "stopping": None if self.stopping is None else self.stopping.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        share = state["share"]
        if not (self._auto and state["first"] is None if share is None else 0.0 < share <= 1.0):
            raise GateStateError(f"The gate state has share={share!r}, expected one in (0, 1]; start the gate afresh.")
        self.share, self._first = share, state["first"]
        self.sampling.load_state_dict(state["sampling"])
        self.watched = frozenset(state["watched"])
        self._recovery.load_state_dict(state)
        earlier = {OF_SHARE: self.sampling.run}  # earlier states have no counts by reason
        self.ran_for.update({reason: int(count) for reason, count in state.get("ran_for", earlier).items()})
        if state["stopping"] is not None:
            self.stopping = EarlyStopping(self._config.tolerance)
            self.stopping.load_state_dict(state["stopping"])
        self._begun = self._entered = False
