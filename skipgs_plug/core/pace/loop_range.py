"""A `range` that leaves numbers out, for the loop that the gate is attached to and for no other."""

from __future__ import annotations

import ast
import functools
import inspect
import sys
import textwrap
from collections.abc import Iterator, Mapping
from types import CodeType
from typing import Any, Protocol

from skipgs_plug.core.errors import SkipGSError
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

    def ended(self, loop: LoopRange) -> None:
        """The loop is over, or was left."""
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
            self._owner.ended(self)

    def __len__(self) -> int:
        return self._owner.expected(self)

    # Python would ask for the length.
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
    """Raise SkipGSError if a loop continues after the iteration at which steps have shrunk to zero."""
    if numbers and numbers[-1] > last:
        raise SkipGSError(
            f"Iterations up to {numbers[-1]} come after a plan that ends with {last}; "
            "give gate.iterations() all iterations of the run at once."
        )


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
        if numbers.step != 1 or not is_looped_over(frame.f_code, frame.f_lineno):
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


@functools.cache
def is_looped_over(code: CodeType, line: int) -> bool:
    """Whether a loop of the function may run over what this line makes.

    `progress_bar = tqdm(range(a, b))` that is moved on by hand counts all iterations; in `for step in progress_bar` it
    counts those that run.
    """
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(code)))
    except (OSError, TypeError, SyntaxError):
        return True
    line -= code.co_firstlineno - 1
    made: set[str] = set()
    given: list[tuple[set[str], set[str]]] = []  # names that assignments set, and those they read
    looped: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, (ast.For, ast.AsyncFor, ast.comprehension)):
            looped |= _names(node.iter)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            given.append((set().union(*map(_names, targets)), _names(node.value)))
            if node.lineno <= line <= (node.end_lineno or node.lineno):
                if not all(isinstance(target, ast.Name) for target in targets):
                    return True  # an attribute: another function may loop over it
                made |= given[-1][0]
    if not made:
        return True
    grown = -1
    while grown != len(looped):
        grown = len(looped)
        for targets_, read in given:
            if targets_ & looped:
                looped |= read
    return bool(made & looped)


def _names(node: ast.AST) -> set[str]:
    return {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}


def line_of(code: CodeType) -> int:
    """Line at which the running function of this code stands, looked for outwards from the caller; 0 without one."""
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_code is code:
            return frame.f_lineno
        frame = frame.f_back  # type: ignore[assignment]
    return 0
