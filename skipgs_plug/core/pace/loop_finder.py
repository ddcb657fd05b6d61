"""Finds the training loop among all loops that count with `range`. A run may have several, one after the other."""

from __future__ import annotations

from skipgs_plug.core.errors import AdapterMismatchError
from skipgs_plug.core.pace.loop_range import LoopRange
from skipgs_plug.core.source.lines import running_loop

# Number of iterations that could be left out, within which the training loop must be found. It is as small as
# `CHECKED_ITERATIONS`, so that the user hears of a missing loop within seconds.
SEARCHED = 10


class LoopFinder:
    """Finds the loop whose numbers are those of the trainer's iterations.

    Attributes:
        found: The present training loop; None until it is known, and after it has ended.
        expected: Number with which the next loop continues, also in a resumed run; None in a new run.
        functions: Names of the functions that may hold the loop, for sentences.
    """

    def __init__(self) -> None:
        self.found: LoopRange | None = None
        self.expected: int | None = None
        self.functions: tuple[str, ...] = ()
        self._matched: LoopRange | None = None  # the loop that was found by its number
        self._candidates: list[LoopRange] = []
        self._without = 0

    def asks(self, loop: LoopRange, number: int) -> bool:
        """Take note that a loop asks about a number; return whether it is the training loop."""
        if self.found is None and number == self.expected == loop.numbers.start:
            self._find(loop)
        if loop is not self.found:
            if self.found is None and loop not in self._candidates:
                self._candidates.append(loop)
            return False
        self.expected = number + 1
        return True

    def begins(self, step: int, needed: bool) -> bool:
        """Take note that the trainer begins iteration `step`; return whether this shows the training loop.

        A loop over epochs may have the number of the first iteration by chance. The next iteration shows the mistake,
        before anything is left out.

        Args:
            step: Number of the iteration.
            needed: Whether the iteration belongs to a phase that leaves out iterations.

        Raises:
            AdapterMismatchError: No loop over a range counts the trainer's iterations.
        """
        if self.found is not None:
            if self.found is not self._matched or self.found.current == step:
                return False
            self.found = self.expected = None
        loop = next((loop for loop in self._candidates if loop.current == step), None)
        self._candidates.clear()
        if loop is not None:
            self._find(loop)
            self.expected = step + 1
            return True
        self._without += needed
        if self._without == SEARCHED:
            sentence = (
                f"No loop over range(...) counts the iterations of this trainer{running_loop(self.functions)}, so the "
                "gate cannot leave any out; use it without share and refine_share, or write one loop over all of them"
            )
            raise AdapterMismatchError(
                f"{sentence}: for step in gate.iterations(range(...)).",
                in_script=f"{sentence}: for step in range(...).",
            )
        return False

    def ended(self, loop: LoopRange) -> bool:
        """Take note that a loop is over, or was left early; return whether it was the training loop."""
        if loop in self._candidates:
            self._candidates.remove(loop)
        if loop is not self.found:
            return False
        self.found = None
        return True

    def _find(self, loop: LoopRange) -> None:
        self.found = self._matched = loop
        self._without = 0
