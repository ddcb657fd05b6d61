"""A `range` that leaves numbers out, for the loop that the gate is attached to and for no other."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from types import CodeType
from typing import Any, Protocol

from skipgs_plug.core.intercept import Patches


class Owner(Protocol):
    """Who says which numbers a loop runs."""

    @property
    def wants_loop(self) -> bool:
        """Whether it is not known yet which loop trains."""
        ...

    def runs(self, loop: LoopRange, number: int) -> bool:
        """Whether the loop runs with this number; asked once for each, in order."""
        ...

    def expected(self, loop: LoopRange) -> int:
        """How many numbers the loop will run, as far as is known."""
        ...


class LoopRange:
    """Counts like the range that it stands for, but asks its owner about each number.

    `len()` is what a progress bar should expect; all else is as in the range.

    Attributes:
        numbers: the range that the loop asked for.
        source: code of the function that asked, and what it had names for; None where nothing is to be read there.
        current: number that was handed out last, None before the first and after the last.
    """

    def __init__(self, numbers: range, owner: Owner, source: tuple[CodeType, Mapping[str, Any]] | None = None) -> None:
        self.numbers, self.source = numbers, source
        self.current: int | None = None
        self._owner = owner

    def __iter__(self) -> Iterator[int]:
        try:
            for number in self.numbers:
                if self._owner.runs(self, number):
                    self.current = number
                    yield number
        finally:
            self.current = None

    def __len__(self) -> int:
        return self._owner.expected(self)

    def __contains__(self, number: object) -> bool:
        return number in self.numbers

    def __getitem__(self, index: Any) -> Any:
        return self.numbers[index]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.numbers, name)

    def __repr__(self) -> str:
        return repr(self.numbers)


class _Every:
    """Owner of a loop that runs all its numbers."""

    wants_loop = False

    def runs(self, loop: LoopRange, number: int) -> bool:
        return True

    def expected(self, loop: LoopRange) -> int:
        return len(loop.numbers)


EVERY = _Every()


def replace_range(patches: Patches, names: dict[str, Any], functions: tuple[str, ...], owner: Owner) -> None:
    """Let functions of a module that say `range(a, b)` get a `LoopRange`, until it is known which loop trains.

    Args:
        patches: Where the replacement is listed.
        names: Global names of the module.
        functions: Names of the functions that hold the training loop.
        owner: Whom to ask about numbers.
    """
    absent = object()
    before = names.get("range", absent)
    plain = range if before is absent else before

    def loop_range(*args: Any) -> Any:
        numbers = plain(*args)
        frame = sys._getframe(1)
        if not owner.wants_loop or frame.f_code.co_name not in functions or type(numbers) is not range:
            return numbers
        if numbers.step != 1:
            return numbers
        # The training loop has not begun, so these names hold no iteration's tensors.
        return LoopRange(numbers, owner, (frame.f_code, {**frame.f_globals, **frame.f_locals}))

    def undo() -> None:
        if before is absent:
            names.pop("range", None)
        else:
            names["range"] = before

    names["range"] = loop_range
    patches.add_undo(f"{names.get('__name__', '__main__')}.range", undo)


def line_of(code: CodeType) -> int:
    """Line at which the running function of this code stands, looked for outwards from the caller; 0 without one."""
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_code is code:
            return frame.f_lineno
        frame = frame.f_back  # type: ignore[assignment]
    return 0
