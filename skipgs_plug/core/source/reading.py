"""Reads the source of the function that asks for a loop's numbers, and finds that loop in it."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterable, Mapping
from types import CodeType
from typing import Any

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.source.lines import GATED_LOOP, head_of, line_in_file
from skipgs_plug.core.source.milestones import TrainingLoop

# Functions that take all numbers from a range at once, before any iteration has run.
GATHERING = frozenset({"list", "set", "sorted", "tuple"})


def read_loop(
    code: CodeType,
    line: int,
    names: Mapping[str, Any],
    pure: Iterable[str] = (),
    known: Mapping[str, Any] | None = None,
) -> TrainingLoop:
    """Return the loop that asks for its numbers.

    Args:
        code: Code of the function that holds the loop.
        line: Present line of the function when the loop asks for a number, which is in the head of its `for`.
        names: Names and values that the function had before the loop.
        pure: Names of functions that only read numbers, and may occur in conditions.
        known: Values of names that the loop assigns, if they are known before the loop.

    Raises:
        SkipGSError: The source cannot be read, or has no loop.
    """
    known = known or {}
    function = code.co_flags & inspect.CO_NEWLOCALS
    try:
        # For the code of a module, getsource returns only the part before its first function.
        source = inspect.getsource(code) if function else "".join(inspect.findsource(code)[0])
        tree = ast.parse(textwrap.dedent(source))
    except (OSError, TypeError, SyntaxError) as error:
        raise SkipGSError(
            f"The source of {code.co_name}() in {code.co_filename} cannot be read ({error}), so the gate cannot know "
            "which iterations must run; gate without share and refine_share, or name them (--always, always=)."
        ) from error
    line_in_source = line - (code.co_firstlineno - 1 if function else 0)
    # The head of a loop inside or around it lies on other lines.
    heads = (node for node in ast.walk(tree) if isinstance(node, ast.For))
    loop = next((one for one in heads if one.lineno <= line_in_source <= (one.iter.end_lineno or one.lineno)), None)
    gathered = loop is not None and _gathers(loop.iter)
    if loop is not None and isinstance(loop.target, ast.Name) and not gathered:
        _refuse_to_yield(loop, code)
        return TrainingLoop(loop, tree, code, {**names, **known}, known, frozenset(pure))
    fault = "takes all numbers before the first iteration" if gathered else "is not in a loop over one number"
    found = f"Line {line} of {code.co_filename} {fault}"
    if loop is not None:
        found = f"{found} ({head_of(loop)})"
    elif not line:
        found = f"{code.co_name}() of {code.co_filename} has ended, and the loop over its iterations is elsewhere"
    raise SkipGSError(
        f"{found}; write the loop as: {GATED_LOOP}.",
        in_script=f"{found}; write the loop as one over range(...) alone, or name the iterations that must run "
        "(--always).",
    )


def _gathers(numbers: ast.expr) -> bool:
    """Whether the head of a loop takes all numbers before the first iteration, as `list(gate.iterations(...))` does."""
    while isinstance(numbers, ast.Call) and isinstance(numbers.func, ast.Name) and numbers.args:
        if numbers.func.id in GATHERING:
            return True
        numbers = numbers.args[0]
    return False


def _refuse_to_yield(loop: ast.For, code: CodeType) -> None:
    """Raise SkipGSError if a loop yields its number: conditions of the code that receives it are not in the loop."""
    assert isinstance(loop.target, ast.Name)
    for node in (part for statement in loop.body for part in ast.walk(statement)):
        if isinstance(node, ast.Yield) and any(
            isinstance(part, ast.Name) and part.id == loop.target.id for part in ast.walk(node)
        ):
            found = f"Line {line_in_file(node, code)} of {code.co_filename} yields the iteration's number to other code"
            unread = "whose conditions on it cannot be read"
            raise SkipGSError(
                f"{found}, {unread}; loop over gate.iterations(range(...)) there, or name the iterations that must run "
                "(always=).",
                in_script=f"{found}, {unread}; name the iterations that must run (--always).",
            )
