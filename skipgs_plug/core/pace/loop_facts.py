"""Facts about a training loop, from its trainer, its user and its source, and the plans that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import CodeType
from typing import Any

from torch import Tensor

from skipgs_plug.core import distributed
from skipgs_plug.core.errors import GateStateError, SkipGSError
from skipgs_plug.core.pace.base import Always, Known, nothing_always, nothing_known
from skipgs_plug.core.pace.loop_range import LoopRange, require_planned
from skipgs_plug.core.pace.phase import NAMED_FOR_TRAINER, Phase, PhasePlan
from skipgs_plug.core.source.lines import line_of
from skipgs_plug.core.source.milestones import TrainingLoop
from skipgs_plug.core.source.progress_bars import Bars
from skipgs_plug.core.source.reading import read_loop
from skipgs_plug.core.trainer_info import Densification, TrainerInfo


class LoopFacts:
    """Collects the facts that the phases of a run need to plan their iterations.

    Args:
        always: Iterations that must run besides those that the loop's conditions name; None if the user named none.

    Attributes:
        start: First iteration of refinement.
        last: Last iteration of the run; None if unknown.
        densification: How to recognise densification events; None if unknown.
        required: Iterations that must run for needs that showed during the run.
        grown: Iterations of the growing phase that the loop's conditions name, by condition.
        refined: Iterations of the refining phase that the conditions name, by condition.
        bars: Progress bars of the loop.
    """

    def __init__(self, always: Iterable[int] | None) -> None:
        self.start = 0
        self.last: int | None = None
        self.densification: Densification | None = None
        self.required: set[int] = set()
        self._saved: dict[str, Any] | None = None  # state that was loaded, until the trainer tells its facts
        self.grown: dict[str, set[int]] = {}
        self.refined: dict[str, set[int]] = {}
        self.bars = Bars([])
        self._others_named = always is not None  # whether the user named those that conditions do not tell
        self._given = self._chosen = frozenset(always or ())  # iterations that must run: by the settings, and in all
        self._always: Always = nothing_always
        self._pure: tuple[str, ...] = ()
        self._known: Known = nothing_known
        self._accumulates = self._steps_each = False
        self._photographs: Callable[[], Iterable[Tensor]] | None = None
        self._slow_positions, self._positions_rate = False, 0.0
        self._random_points: bool | None = None
        self._views: list[str] | None = None
        self._epoch: int | None = None  # iterations that show every view once; None if that is the number of views

    def configure(self, start: int, info: TrainerInfo, views: list[str] | None) -> None:
        """Receive the facts about the trainer; see `Pace.configure`.

        Raises:
            GateStateError: Those that the iterations were planned with until now are of a run with another schedule.
        """
        if self._saved is not None:
            require_same_schedule(self._saved, start, info.max_steps)
        self._saved = None
        self.start, self.last, self._views = start, info.max_steps, views
        self._accumulates, self._steps_each, self._epoch = info.accumulates, info.steps_each, info.epoch
        self.densification = info.densification or self.densification
        self._photographs, self._slow_positions = info.photographs, info.slow_positions
        self._random_points = info.random_points
        self._positions_rate = self._positions_rate or info.positions_rate  # a resumed run begins with another one

    def require_planned(self, numbers: range) -> None:
        """Raise SkipGSError if a loop continues after the last iteration that is known, at which steps are 0.

        The trainer tells it, or the first loop of refinement, or the state of a checkpoint.
        """
        if self.last is not None and numbers and numbers[-1] > self.last:
            if self._saved is not None:
                require_same_schedule(self._saved, self.start, numbers[-1])
            require_planned(numbers, self.last)

    def describe(self, always: Always, pure: Iterable[str], densification: Densification | None, known: Known) -> None:
        """Receive facts from the trainer's adapter; see `Pace.describe`."""
        self._always, self._pure, self.densification, self._known = always, tuple(pure), densification, known

    def choose(
        self, always: Iterable[int] | None, views: list[str] | None, densification: Densification | None
    ) -> None:
        """Receive facts about a loop of the user's own; see `Pace.follow`."""
        self.densification = densification or self.densification
        self._chosen = self._given.union(always or ())
        self._others_named = self._others_named or always is not None
        if views is not None:
            self._views = views

    def read(self, loop: LoopRange, grown: range, refined: range) -> None:
        """Read the conditions and the progress bars of a loop from its source.

        Args:
            loop: The loop. Its source is dropped afterwards.
            grown: Iterations of the growing phase.
            refined: Iterations of the refining phase.

        Raises:
            SkipGSError: The loop cannot be read, or a condition cannot be evaluated ahead because of the loop itself,
                and the user has not named the iterations that must run.
        """
        self.grown, self.refined, self.bars = {}, {}, Bars([])
        source = None if loop.source is None else self._read(*loop.source)
        if source is not None:
            parts = (grown, refined)
            self.grown, self.refined = (source.milestones(part, self._others_named) if part else {} for part in parts)
            self.bars = Bars(source.bar_moves(loop.numbers))
        loop.source = None

    def _read(self, code: CodeType, names: Mapping[str, Any]) -> TrainingLoop | None:
        try:
            return read_loop(code, line_of(code), names, self._pure, self._known(names))
        except SkipGSError:
            if self._others_named:
                return None
            raise

    def plan(self, numbers: range, conditions: dict[str, set[int]], last: int, before: Phase) -> PhasePlan:
        """Return the plan of a phase. All processes must call it together.

        Args:
            numbers: Iterations of the phase.
            conditions: Its iterations that the loop's conditions name: `grown` or `refined`.
            last: Last iteration of the run.
            before: The phase before it.
        """
        own = {n for n in (*self._always(numbers), *self._chosen, *self.required) if n in numbers}
        # A condition may hold on one rank alone, such as `rank == 0 and step % 1000 == 0`.
        found = distributed.united({**conditions, NAMED_FOR_TRAINER: own})
        named = found.pop(NAMED_FOR_TRAINER)
        epoch = self._epoch or (None if self._views is None else len(self._views))
        return PhasePlan(
            numbers,
            found,
            named,
            last,
            before,
            self._views,
            epoch,
            self.densification,
            self._accumulates,
            self._photographs,
            self._slow_positions,
            self._positions_rate,
            self._random_points,
            self._steps_each,
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the facts that a resumed run needs before the trainer tells its own."""
        return {
            "start": self.start,
            "last": self.last,
            "keeps_rates": self._accumulates,
            "steps_each": self._steps_each,
            "views": self._views,
            "epoch": self._epoch,
            "slow_positions": self._slow_positions,
            "positions_rate": self._positions_rate,
        }

    def load_state_dict(self, state: dict[str, Any], configured: bool) -> None:
        """Continue from `state_dict()`; if the trainer has told its facts, only compare the schedule.

        Raises:
            GateStateError: Densification, or the run, ends elsewhere.
        """
        if configured:
            require_same_schedule(state, self.start, None)
            if self.last is None:  # in a loop of the user's own, which is compared when it begins
                self._saved, self.last = state, state["last"]
            return
        self._saved = state
        self.start, self.last, self._accumulates = state["start"], state["last"], state["keeps_rates"]
        self._steps_each = state.get("steps_each", False)
        self._views, self._epoch = state.get("views"), state.get("epoch")
        self._slow_positions = state.get("slow_positions", False)
        self._positions_rate = state.get("positions_rate", 0.0)


def require_same_schedule(state: Mapping[str, Any], start: int, last: int | None) -> None:
    """Require that a state was saved in a run with this first iteration of refinement, and this last iteration.

    The saved plan counts the iterations of both phases, and its steps shrink until the last one. Once refinement has
    begun, a trainer may say that it begins where the run goes on, as a script that only refines does.

    Raises:
        GateStateError: It was not.
    """
    saved_start, saved_last, refines = state["start"], state["last"], (state.get("next") or 0) >= state["start"]
    difference = ""
    if start != saved_start and not refines:
        difference = f"whose refinement begins at iteration {saved_start:,}, not {start:,}"
    elif last is not None and saved_last is not None and last != saved_last:
        difference = f"that ends with iteration {saved_last:,}, not {last:,}"
    if difference:
        raise GateStateError(
            f"The gate state was saved in a run {difference}; continue with the schedule of that run, or start the "
            "gate afresh."
        )
