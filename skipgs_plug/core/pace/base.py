"""The interface of a pace, and the pace of a run in which every iteration runs with the trainer's own rates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import CodeType
from typing import Any

from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.pace.loop_range import LoopRange
from skipgs_plug.core.policy import Policy, SkipPolicy
from skipgs_plug.core.trainer_info import Densification, TrainerInfo

Source = tuple[CodeType, Mapping[str, Any]]  # code of the function that holds a loop, and the names that it had
Always = Callable[[range], Iterable[int]]
Known = Callable[[Mapping[str, Any]], Mapping[str, Any]]


def nothing_always(numbers: range) -> Iterable[int]:
    """Return no iterations: only the iterations that the loop's own conditions name must run."""
    return ()


def nothing_known(names: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return no values: the names that the loop assigns have no known value."""
    return {}


class Pace:
    """Every iteration runs, and learning rates do not change.

    Other paces derive from this one. A pace gets one question per iteration, whether it runs (`LoopRange` asks the
    owner's `runs`), and one report, that it begins (`begin`, from the engine).

    Attributes:
        number: Number of the iteration that the training loop is in; None while the loop is unknown, and after it.
        gap: Number of iterations that were left out right before the present one.
        ran: Number of iterations of the training loop that ran in this process, with the present one.
        left_out: Number of iterations of the training loop that were left out before the present one.
    """

    number: int | None = None
    gap: int = 0
    ran: int = 0
    left_out: int = 0

    def configure(self, start: int, info: TrainerInfo, views: list[str] | None) -> None:
        """Receive the facts about the trainer.

        Args:
            start: First iteration of refinement.
            info: Facts about the trainer.
            views: Keys of all training views; None if they are unknown.

        Raises:
            SkipGSError: This pace does not work with this trainer.
        """

    def policy(self, config: SkipConfig) -> Policy:
        """Return the policy that decides on the backward passes of iterations that run."""
        return SkipPolicy.from_config(config)

    def follow(
        self,
        numbers: range,
        source: Source | None,
        always: Iterable[int] | None = None,
        views: list[str] | None = None,
        densification: Densification | None = None,
    ) -> LoopRange:
        """Return the loop that replaces `numbers` in a training loop of the user's own.

        Args:
            numbers: All iterations of the run, or all that are left.
            source: Code in which the loop's conditions are read; None to read no conditions.
            always: Iterations that must run besides those that conditions name. Conditions that cannot be read are no
                error then. None if the user named none.
            views: Keys of all training views; None if the trainer's adapter passes them.
            densification: Densification events; None if they are unknown, or if the trainer's adapter knows them.

        Raises:
            SkipGSError: The numbers go on after those of an earlier plan.
        """
        return LoopRange(numbers, EveryNumber(lambda: None))

    def begin(self, step: int, policy: Policy | None) -> None:
        """Begin an iteration.

        Args:
            step: Number of the iteration.
            policy: Decides on backward passes; None before `Engine.configure`.

        Raises:
            SkipGSError: Iterations are to be left out, and no loop is known that could leave them out.
        """

    def describe(
        self,
        always: Always = nothing_always,
        pure: Iterable[str] = (),
        densification: Densification | None = None,
        known: Known = nothing_known,
        functions: tuple[str, ...] = (),
    ) -> None:
        """Receive facts that the loop's source does not show.

        Args:
            always: Returns further iterations that must run.
            pure: Names of functions that only read numbers, and may occur in the loop's conditions.
            densification: How to recognise densification events; None if `configure` tells it, or if it is unknown.
            known: Receives all names of the loop's function right before the loop's conditions are read, and returns
                values of names that the loop assigns, if they are known before.
            functions: Names of the functions that may hold the loop.
        """

    def require(self, number: int) -> None:
        """Make iteration `number` run. Call it for a need that shows only during the run."""

    def is_named(self, number: int) -> bool:
        """Return whether a condition of the loop, or the adapter, may name iteration `number`."""
        return True

    @property
    def at_half_size(self) -> bool:
        """Whether the present iteration trains on a photograph of half the width and height."""
        return False

    @property
    def leaves_out(self) -> bool:
        """Whether whole iterations may be left out; the pace then needs the training loop."""
        return False

    def remove(self) -> None:
        """Release the loop, which runs all its numbers from now on."""

    def report(self) -> dict[str, Any] | None:
        """Return the entries of skipgs.json about left-out iterations; None if this pace leaves out no iteration."""
        return None

    def state_dict(self) -> dict[str, Any] | None:
        """Return the state; None if nothing changes."""
        return None

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict()`."""


class EveryNumber:
    """Owner of a loop that runs all its numbers; `at_end` is called when the loop is over, or was left early."""

    wants_loop = False

    def __init__(self, at_end: Callable[[], None]) -> None:
        self._at_end = at_end

    def runs(self, loop: LoopRange, number: int) -> bool:
        return True

    def expected(self, loop: LoopRange) -> int:
        return len(loop.numbers)

    def ended(self, loop: LoopRange) -> None:
        self._at_end()
