"""A `range` that leaves numbers out, for the loop that the gate is attached to and for no other."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from types import CodeType
from typing import Any, Protocol

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.intercept import Patches
from skipgs_plug.core.source.lines import frame_of, is_looped_over


class Owner(Protocol):
    """Decides which numbers a loop runs."""

    @property
    def wants_loop(self) -> bool:
        """Whether no training loop is running, so that the next loop may be one."""
        ...

    def runs(self, loop: LoopRange, number: int) -> bool:
        """Whether the loop runs with this number; called once for each number, in order."""
        ...

    def expected(self, loop: LoopRange) -> int:
        """Return the number of iterations that the loop will run, as far as it is known."""
        ...

    def ended(self, loop: LoopRange) -> None:
        """Take note that the loop is over, or was left early."""
        ...


class LoopRange:
    """Counts like the range that it replaces, but asks its owner about each number.

    `len()` is the number of iterations that a progress bar should expect; the function that asked for the range gets
    the range's own length. Everything else is that of the range.

    Attributes:
        numbers: The range that the loop asked for.
        source: Code of the function that asked, with the names and values that it had before the loop; None if its
            conditions need not be read.
        current: The number that was returned last; None before the first and after the last.
        around: Returns a block that the loop runs in.
    """

    def __init__(self, numbers: range, owner: Owner, source: tuple[CodeType, Mapping[str, Any]] | None = None) -> None:
        self.numbers, self.source = numbers, source
        self.current: int | None = None
        self.around: Callable[[], AbstractContextManager[None]] = nullcontext
        self._owner = owner
        self._asked_by = None if source is None else source[0]

    def __iter__(self) -> Iterator[int]:
        self._read_names()
        with self.around():
            try:
                for number in self.numbers:
                    if self._owner.runs(self, number):
                        self.current = number
                        yield number
            finally:
                self.current = None
                self._owner.ended(self)

    def _read_names(self) -> None:
        """Read the names again right before the loop: some may be assigned after the range is made."""
        frame = None if self.source is None else frame_of(self.source[0])
        if frame is not None:
            names = {**frame.f_globals, **frame.f_locals}
            plain = {name: value.numbers for name, value in names.items() if isinstance(value, LoopRange)}
            self.source = frame.f_code, {**names, **plain}

    def __len__(self) -> int:
        inside = sys._getframe(1).f_code is self._asked_by
        return len(self.numbers) if inside else self._owner.expected(self)

    # Without this method Python would use the length.
    def __bool__(self) -> bool:
        return bool(self.numbers)

    def __reversed__(self) -> Iterator[int]:
        return reversed(self.numbers)

    def __contains__(self, number: object) -> bool:
        return number in self.numbers

    def __getitem__(self, index: Any) -> Any:
        return self.numbers[index]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.numbers, name)

    def __repr__(self) -> str:
        return repr(self.numbers)


def require_planned(numbers: range, last: int) -> None:
    """Raise SkipGSError if a loop continues after the last iteration that is known, at which steps shrink to zero."""
    if numbers and numbers[-1] > last:
        sentence = f"Iterations up to {numbers[-1]} come after a plan that ends with {last}"
        raise SkipGSError(
            f"{sentence}; give gate.iterations() all iterations of the run at once.",
            in_script=f"{sentence}; use the gate without share and refine_share.",
        )


def replace_range(patches: Patches, names: dict[str, Any], functions: tuple[str, ...], owner: Owner) -> None:
    """Give functions of a module that call `range(a, b)` a `LoopRange`, except while the training loop is running.

    Args:
        patches: List of replacements, to which this one is added.
        names: Global names of the module.
        functions: Names of the functions that may hold the training loop.
        owner: Decides about the numbers.
    """
    absent = object()
    before = names.get("range", absent)
    plain = range if before is absent else before

    def loop_range(*args: Any) -> Any:
        numbers = plain(*args)
        frame = sys._getframe(1)
        if not owner.wants_loop or frame.f_code.co_name not in functions or type(numbers) is not range:
            return numbers
        if numbers.step != 1 or not is_looped_over(frame.f_code, frame.f_lineno):
            return numbers
        # No training loop is running. Tensors of an earlier loop's last iteration are kept until this loop is read.
        return LoopRange(numbers, owner, (frame.f_code, {**frame.f_globals, **frame.f_locals}))

    def undo() -> None:
        if before is absent:
            names.pop("range", None)
        else:
            names["range"] = before

    names["range"] = loop_range
    patches.add_undo(f"{names.get('__name__', '__main__')}.range", undo)
