"""The pace of a run that leaves out iterations. It connects the training loop, its phases and the learning rates."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from skipgs_plug.core import distributed
from skipgs_plug.core.caution import caution
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pace.base import Always, Known, Pace, Source, nothing_always, nothing_known
from skipgs_plug.core.pace.growing import Growing
from skipgs_plug.core.pace.loop_finder import LoopFinder
from skipgs_plug.core.pace.loop_range import LoopRange, require_planned
from skipgs_plug.core.pace.phase import NAMED_FOR_TRAINER, Phase, PhasePlan
from skipgs_plug.core.pace.rates import ScaledRates
from skipgs_plug.core.pace.refinement_policy import RefinementPolicy
from skipgs_plug.core.pace.refining import Refining
from skipgs_plug.core.policy import Policy
from skipgs_plug.core.release import Release
from skipgs_plug.core.source.lines import GATED_LOOP, line_of
from skipgs_plug.core.source.milestones import read_loop
from skipgs_plug.core.source.progress_bars import Bars
from skipgs_plug.core.trainer_info import Densification, TrainerInfo


class Phased(Pace):
    """Asks the phase of an iteration whether the iteration runs.

    Args:
        config: Settings with `leaves_out`.
        rates: Scales learning rates.
        go_on: Receives the first iteration of a resumed run, and loads the state of its checkpoint, if there is one.
        release: Receives errors, and raises them or releases the gate.

    Attributes:
        refining: The phase after densification.
        growing: The phase before the end of densification.
    """

    def __init__(self, config: SkipConfig, rates: ScaledRates, go_on: Callable[[int], None], release: Release) -> None:
        self._config = config
        self._rates = rates
        self._go_on = go_on
        self._release = release
        self.refining = Refining(config, rates)
        self.growing: Phase = Phase() if config.growing is None else Growing(config, rates)
        self._grows = self.growing  # phase of the iterations before `_start` in the present loop
        self._finder = LoopFinder()
        self._densification: Densification | None = None
        self._accumulates = self._steps_each = False
        self._views: list[str] | None = None
        self._epoch: int | None = None  # iterations that show every view once; None if that is the number of views
        self._start = 0
        self._last: int | None = None
        self._always: Always = nothing_always
        self._chosen = frozenset(config.always or ())
        self._pure: tuple[str, ...] = ()
        self._known: Known = nothing_known
        self._required: set[int] = set()
        # Iterations that the loop's conditions name, by condition: of the growing phase, and of the refining phase.
        self._conditions: list[dict[str, set[int]]] = [{}, {}]
        self._planned: LoopRange | None = None  # loop whose conditions were read; nothing in it is refused after that
        self._left_out = 0
        self._bars = Bars([])
        self._attached = False  # by an adapter
        self._asked = False  # whether the user was told, in the first iteration, that the loop is not known
        self._configured = self._removed = False

    # Facts about the trainer.

    def configure(self, start: int, info: TrainerInfo, views: list[str] | None) -> None:
        self._start, self._last, self._views = start, info.max_steps, views
        self._accumulates, self._steps_each, self._epoch = info.accumulates, info.steps_each, info.epoch
        self._densification = info.densification or self._densification
        self._configured = True

    def policy(self, config: SkipConfig) -> Policy:
        return RefinementPolicy(config, self.refining)

    def describe(
        self,
        always: Always = nothing_always,
        pure: Iterable[str] = (),
        densification: Densification | None = None,
        known: Known = nothing_known,
        functions: tuple[str, ...] = (),
    ) -> None:
        self._always, self._pure, self._densification, self._known = always, tuple(pure), densification, known
        self._finder.functions = functions
        self._attached = True

    def require(self, number: int) -> None:
        self._required.add(number)
        self.refining.require(number)
        self.growing.require(number)

    def is_named(self, number: int) -> bool:
        return number in self._required or self._phase(number).is_named(number)

    def follow(
        self,
        numbers: range,
        source: Source | None,
        always: Iterable[int] = (),
        views: list[str] | None = None,
        events: Iterable[int] | None = None,
    ) -> LoopRange:
        if events is not None:
            known = frozenset(int(number) for number in events)
            self._densification = Densification(numbers=lambda part: known.intersection(part))
        self._chosen = frozenset((*always, *(self._config.always or ())))
        if views is not None:
            self._views = views
        if self.refining.begun and self._last is not None:
            require_planned(numbers, self._last)
        self._finder.found = LoopRange(numbers, self, source)
        return self._finder.found

    def remove(self) -> None:
        self._removed = True
        self.refining.remove()

    # Questions and reports of the engine and the hooks.

    @property
    def leaves_out(self) -> bool:
        return True

    @property
    def number(self) -> int | None:  # type: ignore[override]
        loop = self._finder.found
        return None if loop is None else loop.current

    def begin(self, step: int, policy: Policy | None) -> None:
        # An adapter's loop is searched for from the first iteration on, so that a refusal comes before any training.
        needed = self._attached or self._grows.leaves_out or step >= self._start
        if not self._attached and self.number is None and not self._removed:
            self._ask_for_loop(needed)
        self._asked = True
        if self._finder.begins(step, needed) and step >= self._start:
            self.refining.count_first(step)

    # Questions of loops.

    @property
    def wants_loop(self) -> bool:
        """Whether no training loop is running, so that the next loop may be one."""
        return self._finder.found is None

    def runs(self, loop: LoopRange, number: int) -> bool:
        """Whether the loop runs with this number; called once for each number, in order.

        Raises:
            SkipGSError: The loop's conditions cannot be evaluated ahead. It is raised at the first number that could be
                left out, never later, and before any training.
        """
        if self._removed:
            return True
        try:
            return self._runs(loop, number)
        except Exception as error:
            self._release.on_error(error, number, refuses=self._planned is not loop)
            return True

    def _runs(self, loop: LoopRange, number: int) -> bool:
        if number == loop.numbers.start > 0 and self.wants_loop:
            self._go_on(number)
        if not self._finder.asks(loop, number) or not self._configured:
            return True
        if self._planned is not loop:
            self._read(loop, number)
        runs = self._phase(number).runs(number)
        if runs:
            self.gap, self._left_out = self._left_out, 0
            if self.gap:
                self._bars.catch_up()
        else:
            self._left_out += 1
            self._bars.left_out(number)
        return runs

    def _phase(self, number: int) -> Phase:
        return self._grows if number < self._start else self.refining

    def expected(self, loop: LoopRange) -> int:
        """Return the number of iterations that the loop will run, as far as it is known."""
        numbers = loop.numbers
        if self._removed:
            return len(numbers)
        before = len(range(numbers.start, min(max(self._start, numbers.start), numbers.stop)))
        grown, refined = self._grows.share or 1.0, self.refining.share or 1.0
        return round(before * grown) + round((len(numbers) - before) * refined)

    def ended(self, loop: LoopRange) -> None:
        """Leave rates alone once the loop is over, or was left early: later optimizer steps are not part of it."""
        if self._finder.ended(loop):
            self._planned = None
            self._rates.pause()

    def _ask_for_loop(self, needed: bool) -> None:
        """Tell the user that the gate must count the iterations of a loop of their own.

        Raises:
            SkipGSError: The present iteration could have been left out.
        """
        how = f"so the gate must count them; write the loop as: {GATED_LOOP}."
        if needed or self._release.in_script:
            leaves_out = "share and refine_share leave out iterations"
            raise SkipGSError(
                f"{leaves_out}, {how}",
                in_script=f"{leaves_out}, but this adapter names no loop; use the gate without them.",
            )
        if not self._asked:
            caution(f"refine_share leaves out iterations from {self._start} on, {how}")

    def _read(self, loop: LoopRange, number: int) -> None:
        """Plan the rest of the run by the loop's conditions, at the loop's first number that can be left out.

        Loops that follow each other are read one after the other, and each plan takes the place of the one before.
        """
        if self.refining.begun and self._last is not None:
            require_planned(loop.numbers, self._last)
        # On resume, include iterations that are done already, because conditions are judged by how often they hold.
        # A trainer that is trained in parts, such as train(until=1000), has more numbers than its first loop.
        end = loop.numbers.stop if self._last is None else max(loop.numbers.stop, self._last + 1)
        grown = self.growing.numbers(number, min(self._start, end))
        refined = self.refining.numbers(max(self._start, number), end)
        grows = bool(grown) and number < self._start
        if grows:
            self._require_events()
        if loop.source is not None and self._config.always is None:
            code, names = loop.source
            read = read_loop(code, line_of(code), names, self._pure, self._known(names))
            self._conditions = [read.milestones(numbers) if numbers else {} for numbers in (grown, refined)]
            self._bars = Bars(read.bar_moves(loop.numbers))
        elif self._planned is not loop:  # they are known if a state is loaded inside this loop
            self._conditions, self._bars = [{}, {}], Bars([])
        loop.source = None
        last = loop.numbers[-1] if self._last is None else self._last
        if grown:  # also after the phase, whose length the refining phase must know in a resumed run
            plan = self._plan(grown, self._conditions[0], last, Phase())
            known = self._densification is not None and self.growing.begin(plan)
            self._grows = self.growing if known else Phase()
            if grows and not known:
                until = min(grown.stop, loop.numbers.stop) - 1
                caution(
                    f"The densification events of iterations {number} to {until} are not known, so all of these "
                    f"iterations run, and only later ones are left out.{self._why_no_event()}"
                )
        if refined:
            self._last = last  # settled, because steps shrink until then
            self.refining.begin(self._plan(refined, self._conditions[1], last, self.growing))
        self._planned = loop

    def _plan(self, numbers: range, conditions: dict[str, set[int]], last: int, before: Phase) -> PhasePlan:
        own = {n for n in (*self._always(numbers), *self._chosen, *self._required) if n in numbers}
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
            self._densification,
            self._accumulates,
            self._steps_each,
        )

    def _require_events(self) -> None:
        """Refuse `grow_share` if the densification events are not known. With `share`, densification runs whole then.

        Raises:
            SkipGSError: They are not known.
        """
        if self._densification is None and self._config.share is None:
            sentence = (
                "grow_share leaves out iterations of densification, but the densification events of this trainer are "
                "not known; remove grow_share"
            )
            raise SkipGSError(f"{sentence}, or give events= to gate.iterations().", in_script=f"{sentence}.")

    def _why_no_event(self) -> str:
        """Return why no densification event is known, as a sentence after a space; empty if there is nothing to add."""
        if self._densification is None:
            return "" if self._release.in_script else " In a loop of your own give events= to gate.iterations()."
        marks = ", ".join(self._densification.marks)
        if self._config.always is None:
            return f" No condition of the loop that names {marks} holds before iteration {self._start}."
        return f" The numbers given as always replace the loop's conditions, also those that name {marks}."

    # State and report.

    def report(self) -> dict[str, Any]:
        return {
            **self.refining.report(),
            "gaussians_shown": self._rates.visibility.visible,
            "growing": self.growing.report(),  # None, too, if the phase runs whole
        }

    def state_dict(self) -> dict[str, Any]:
        return {
            "start": self._start,
            "last": self._last,
            "keeps_rates": self._accumulates,
            "steps_each": self._steps_each,
            "next": self._finder.expected,
            "required": sorted(self._required),
            "refining": self.refining.state_dict(),
            "grow_asked": self._config.growing,
            "growing": self.growing.state_dict(),  # None, too, if the phase runs whole
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        growing = state["growing"]
        asked = state.get("grow_asked", None if growing is None else growing["asked"])
        if (state["refining"]["asked"], asked) != (self._config.refining, self._config.growing):
            raise SkipGSError(
                f"The gate state was saved with refine_share={state['refining']['asked']!r} and "
                f"grow_share={asked!r}, not {self._config.refining!r} and {self._config.growing!r}; continue with "
                "those settings, or start the gate afresh."
            )
        self._required = set(state["required"])
        self.refining.load_state_dict(state["refining"])
        if growing is not None:
            self.growing.load_state_dict(growing)
        self._finder.expected = state["next"]
        # The loop asks about its first number before the trainer reports its facts.
        if not self._configured:
            self._start, self._last, self._accumulates = state["start"], state["last"], state["keeps_rates"]
            self._steps_each = state.get("steps_each", False)
            self._configured = True
        if self._planned is not None:
            self._read(self._planned, max(self._start, state["next"] or 0))
