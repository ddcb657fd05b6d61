"""Counters of a loop: names and attributes that count the iterations that run, as `images += 1` does."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MethodType
from typing import Any

from skipgs_plug.core.source.assignments import assignments_in
from skipgs_plug.core.source.conditions import unconditional
from skipgs_plug.core.source.functions import called_function, syntax_of, undecorated, value_of
from skipgs_plug.core.source.project import Project


def counters(
    body: Sequence[ast.stmt], names: Mapping[str, Any], assigned: Collection[str], project: Project
) -> Iterator[str]:
    """Yield the names and attributes to which a loop adds a constant in every iteration, and that it never sets back.

    They are those of the loop, and those of objects that the loop calls in every iteration, as in `saver.count()`, or
    in `is_due()` for an object that can be called.

    Args:
        body: The loop's statements.
        names: Names and values before the loop.
        assigned: Names and attributes that the loop assigns.
        project: The user's project. Methods of libraries are not read.
    """
    yield from _counted(body)
    for called in (part.func for one in unconditional(body) for part in _always_reached(one)):
        found = called_function(called, names, lambda place: value_of(place, names, assigned))
        if isinstance(found, MethodType):
            function = undecorated(found)
            syntax = None if function is None or function not in project else syntax_of(function)
            if syntax is not None and syntax.args.args:
                own = f"{syntax.args.args[0].arg}."
                owner = ast.unparse(called).removesuffix(f".{syntax.name}")  # an object that is called has no suffix
                counted = (text for text in _counted(syntax.body) if text.startswith(own))
                yield from (f"{owner}.{text.removeprefix(own)}" for text in counted)


def _counted(body: Sequence[ast.stmt]) -> Iterator[str]:
    assigned = assignments_in(body).assigned
    for node in unconditional(body):
        if isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add) and isinstance(node.value, ast.Constant):
            text = ast.unparse(node.target)
            if assigned.count(text) == 1:
                yield text


def _always_reached(statement: ast.stmt) -> Iterator[ast.Call]:
    """Yield the calls in a statement that has no block, or in the condition of an `if`."""
    reached = statement.test if isinstance(statement, ast.If) else statement
    if isinstance(reached, (ast.expr, ast.Expr, ast.Assign, ast.AnnAssign)):
        yield from (part for part in ast.walk(reached) if isinstance(part, ast.Call))
