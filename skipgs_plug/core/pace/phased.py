"""The pace of a run that leaves out iterations. It connects the training loop, its phases and the learning rates."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from skipgs_plug.core.caution import caution
from skipgs_plug.core.config import SkipConfig, shares_as_given
from skipgs_plug.core.errors import GateStateError, SkipGSError
from skipgs_plug.core.pace.base import Always, Known, Pace, Source, nothing_always, nothing_known
from skipgs_plug.core.pace.growing import Growing
from skipgs_plug.core.pace.half_size import require_half_size
from skipgs_plug.core.pace.loop_facts import LoopFacts
from skipgs_plug.core.pace.loop_finder import LoopFinder
from skipgs_plug.core.pace.loop_range import LoopRange
from skipgs_plug.core.pace.phase import Phase
from skipgs_plug.core.pace.rates import ScaledRates
from skipgs_plug.core.pace.refinement_policy import RefinementPolicy
from skipgs_plug.core.pace.refining import Refining
from skipgs_plug.core.policy import Policy
from skipgs_plug.core.release import Release
from skipgs_plug.core.source.lines import GATED_LOOP
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
        self._grows = self.growing  # phase of the iterations before refinement in the present loop
        self._finder = LoopFinder()
        self._facts = LoopFacts(config.always)
        self._planned: LoopRange | None = None  # loop whose conditions were read; nothing in it is refused after that
        self._left_out = 0  # since the last iteration that ran
        self._attached = False  # whether an adapter described the loop
        self._asked = False  # whether the user was told, in the first iteration, that the loop is not known
        self._configured = self._removed = False

    # Facts about the trainer.

    def configure(self, start: int, info: TrainerInfo, views: list[str] | None) -> None:
        require_half_size(self._config, info.photographs)
        self._facts.configure(start, info, views)
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
        self._facts.describe(always, pure, densification, known)
        self._finder.functions = functions
        self._attached = True

    def require(self, number: int) -> None:
        self._facts.required.add(number)
        self.refining.require(number)
        self.growing.require(number)

    def is_named(self, number: int) -> bool:
        return number in self._facts.required or self._phase(number).is_named(number)

    def follow(
        self,
        numbers: range,
        source: Source | None,
        always: Iterable[int] | None = None,
        views: list[str] | None = None,
        densification: Densification | None = None,
    ) -> LoopRange:
        self._facts.choose(always, views, densification)
        self._facts.require_planned(numbers)
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

    @property
    def at_half_size(self) -> bool:
        number = self.number
        return number is not None and not self._removed and self._phase(number).at_half_size(number)

    def begin(self, step: int, policy: Policy | None) -> None:
        # An adapter's loop is searched for from the first iteration on, so that a refusal comes before any training.
        needed = self._attached or self._grows.leaves_out or step >= self._facts.start
        if not self._attached and self.number is None and not self._removed:
            self._ask_for_loop(needed)
        self._asked = True
        if self._finder.begins(step, needed):
            self.ran += 1  # the loop asked about it before it was known
            if step >= self._facts.start:
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
        runs = True
        if not self._removed:
            try:
                runs = self._runs(loop, number)
            except Exception as error:
                self._release.on_error(error, number, refuses=self._planned is not loop)
        if loop is self._finder.found:
            self._count(runs)
        return runs

    def _count(self, runs: bool) -> None:
        if not runs:
            self._left_out += 1
            return
        self.gap, self._left_out = self._left_out, 0
        self.ran += 1
        self.left_out += self.gap

    def _runs(self, loop: LoopRange, number: int) -> bool:
        if number == loop.numbers.start > 0 and self.wants_loop:
            self._go_on(number)
        if not self._finder.asks(loop, number) or not self._configured:
            return True
        if self._planned is not loop:
            self._read(loop, number)
        runs = self._phase(number).runs(number)
        if runs:
            if self._left_out:
                self._facts.bars.catch_up()
        else:
            self._facts.bars.left_out(number)
        return runs

    def _phase(self, number: int) -> Phase:
        return self._grows if number < self._facts.start else self.refining

    def expected(self, loop: LoopRange) -> int:
        """Return the number of iterations that the loop will run, as far as it is known."""
        numbers = loop.numbers
        if self._removed:
            return len(numbers)
        before = len(range(numbers.start, min(max(self._facts.start, numbers.start), numbers.stop)))
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
            caution(f"refine_share leaves out iterations from {self._facts.start} on, {how}")

    def _read(self, loop: LoopRange, number: int) -> None:
        """Plan the rest of the run by the loop's conditions, at the loop's first number that can be left out.

        Loops that follow each other are read one after the other, and each plan takes the place of the one before.
        """
        facts = self._facts
        self._facts.require_planned(loop.numbers)
        # On resume, include iterations that are done already, because conditions are judged by how often they hold.
        # A trainer that is trained in parts, such as train(until=1000), has more numbers than its first loop.
        end = loop.numbers.stop if facts.last is None else max(loop.numbers.stop, facts.last + 1)
        grown = self.growing.numbers(number, min(facts.start, end))
        refined = self.refining.numbers(max(facts.start, number), end)
        grows = bool(grown) and number < facts.start
        if grows:
            self._require_events()
        if self._planned is not loop:  # a state may be loaded inside a loop that was read
            facts.read(loop, grown, refined)
        last = loop.numbers[-1] if facts.last is None else facts.last
        if grown:  # also after the phase, whose length the refining phase must know in a resumed run
            plan = facts.plan(grown, facts.grown, last, Phase())
            known = facts.densification is not None and self.growing.begin(plan)
            self._grows = self.growing if known else Phase()
            if grows and not known:
                until = min(grown.stop, loop.numbers.stop) - 1
                caution(
                    f"The densification events of iterations {number} to {until} are not known, so all of these "
                    f"iterations run, and only later ones are left out.{self._why_no_event()}"
                )
        if refined:
            facts.last = last  # settled, because steps shrink until then
            self.refining.begin(facts.plan(refined, facts.refined, last, self.growing))
        self._planned = loop

    def _require_events(self) -> None:
        """Refuse `grow_share` if the densification events are not known. With `share`, densification runs whole then.

        Raises:
            SkipGSError: They are not known.
        """
        if self._facts.densification is None and self._config.share is None:
            sentence = (
                "grow_share leaves out iterations of densification, but the densification events of this trainer are "
                "not known; remove grow_share"
            )
            raise SkipGSError(f"{sentence}, or give events= to gate.iterations().", in_script=f"{sentence}.")

    def _why_no_event(self) -> str:
        """Return why no densification event is known, as a sentence after a space; empty if there is nothing to add."""
        if self._facts.densification is None:
            return "" if self._release.in_script else " In a loop of your own give events= to gate.iterations()."
        marks = ", ".join(self._facts.densification.marks)
        return f" No condition of the loop that names {marks} holds before iteration {self._facts.start}."

    # State and report.

    def report(self) -> dict[str, Any]:
        return {
            **self.refining.report(),
            "gaussians_shown": self._rates.visibility.visible,
            "growing": self.growing.report(),  # None, too, if the phase runs whole
        }

    def state_dict(self) -> dict[str, Any]:
        return {
            **self._facts.state_dict(),
            "next": self._finder.expected,
            "required": sorted(self._facts.required),
            "refining": self.refining.state_dict(),
            "grow_asked": self._config.growing,
            "growing": self.growing.state_dict(),  # None, too, if the phase runs whole
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        growing = state["growing"]
        if _asked_in(state) != (self._config.growing, self._config.refining):
            raise other_shares(state, self._config)
        # First, since it can refuse the state. The loop asks about its first number before the trainer tells its facts.
        self._facts.load_state_dict(state, self._configured)
        self._facts.required = set(state["required"])
        self.refining.load_state_dict(state["refining"])
        if growing is not None:
            self.growing.load_state_dict(growing)
        self._finder.expected = state["next"]
        self._configured = True
        if self._planned is not None:
            self._read(self._planned, max(self._facts.start, state["next"] or 0))


def other_shares(state: dict[str, Any] | None, config: SkipConfig) -> GateStateError:
    """Return the error about a state of other shares than the run asks for; None is the state of a run without one."""
    saved = shares_as_given(None, None) if state is None else shares_as_given(*_asked_in(state))
    return GateStateError(
        f"The gate state was saved with {saved}, not {shares_as_given(config.growing, config.refining)}; continue with "
        "that setting, or start the gate afresh."
    )


def _asked_in(state: dict[str, Any]) -> tuple[float | str | None, float | str | None]:
    """Return the shares of both phases that the saved run asked for."""
    growing = state["growing"]
    return state.get("grow_asked", None if growing is None else growing["asked"]), state["refining"]["asked"]
