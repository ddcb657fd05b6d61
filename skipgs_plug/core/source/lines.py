"""Lines of running functions: the present one, the loop around it, and whether a loop runs over a range made there."""

from __future__ import annotations

import ast
import functools
import inspect
import sys
import textwrap
from collections.abc import Container
from types import CodeType, FrameType

# How messages describe a loop of which iterations can be left out. A data loader must not set its pace.
GATED_LOOP = (
    "for step in gate.iterations(range(...)), with views and batches taken in its body, such as by next(batches)"
)


@functools.cache
def is_looped_over(code: CodeType, line: int) -> bool:
    """Whether a loop of the function may run over the range that this line creates.

    A bar `progress_bar = tqdm(range(a, b))` that the loop advances by hand counts all iterations. A bar in
    `for step in progress_bar` counts the iterations that run.
    """
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(code)))
    except (OSError, TypeError, SyntaxError):
        return True
    line -= code.co_firstlineno - 1
    made: set[str] = set()
    given: list[tuple[set[str], set[str]]] = []  # names that an assignment sets, and names that it reads
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
    """Return the present line of the innermost running function with this code; 0 if none is running."""
    frame = frame_of(code)
    return 0 if frame is None else frame.f_lineno


def frame_of(code: CodeType) -> FrameType | None:
    """Return the frame of the innermost running function with this code; None if none is running."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None and frame.f_code is not code:
        frame = frame.f_back
    return frame


def running_loop(functions: Container[str]) -> str:
    """Return line, file and head of the loop that runs in a function of these names, after a space and in brackets.

    It is the innermost loop around the present line of the innermost function. The text is empty if there is none.
    """
    frame = sys._getframe(1)
    while frame is not None and frame.f_code.co_name not in functions:
        frame = frame.f_back  # type: ignore[assignment]
    if frame is None:
        return ""
    code, before = frame.f_code, frame.f_code.co_firstlineno - 1
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(code)))
    except (OSError, TypeError, SyntaxError):
        return ""
    line = frame.f_lineno - before
    loops = [node for node in ast.walk(tree) if isinstance(node, (ast.For, ast.While))]
    around = [one for one in loops if one.lineno <= line <= (one.end_lineno or one.lineno)]
    if not around:
        return ""
    loop = max(around, key=lambda one: one.lineno)
    return f" (line {loop.lineno + before} of {code.co_filename}: {head_of(loop)})"


def head_of(loop: ast.For | ast.While) -> str:
    """Return the first line of a loop, without its colon."""
    return ast.unparse(loop).partition(":\n")[0]


def line_in_file(node: ast.expr, code: CodeType) -> int:
    """Return the line of the file in which a part of this code begins."""
    return node.lineno + (code.co_firstlineno - 1 if code.co_flags & inspect.CO_NEWLOCALS else 0)
