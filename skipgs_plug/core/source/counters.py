"""Counters of a loop: names and attributes that count the iterations that run, as `images += 1` does."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MethodType
from typing import Any, TypeGuard

from skipgs_plug.core.source.assignments import assignments_in
from skipgs_plug.core.source.conditions import position, unconditional
from skipgs_plug.core.source.functions import called_function, syntax_of, undecorated, value_of
from skipgs_plug.core.source.project import Project


def counters(
    body: Sequence[ast.stmt], names: Mapping[str, Any], assigned: Collection[str], project: Project
) -> tuple[set[str], set[tuple[int, int]]]:
    """Return the names and attributes to which a loop adds a constant in every iteration.

    They are those of the loop, and those of objects that the loop calls in every iteration, as in `saver.count()`, or
    in `is_due()` for an object that can be called. The loop may set its own back, as PUP 3D-GS does at each prune.

    Args:
        body: The loop's statements.
        names: Names and values before the loop.
        assigned: Names and attributes that the loop assigns.
        project: The user's project. Methods of libraries are not read.

    Returns:
        The counters, and the positions of conditions under which one is set back. A loop that gathers over a few
        iterations has no other condition on its counter.
    """
    back = dict(_set_back(body))
    conditions = {position(one.test) for ifs in back.values() for one in ifs}
    return {*back, *_counted(body), *_counted_by_objects(body, names, assigned, project)}, conditions


def _set_back(body: Sequence[ast.stmt]) -> Iterator[tuple[str, list[ast.If]]]:
    """Yield the counters that a loop sets back, each with the statements under which it does so."""
    ifs = [part for statement in body for part in ast.walk(statement) if isinstance(part, ast.If)]
    for statement in unconditional(body):
        for node in unconditional(statement.orelse) if isinstance(statement, ast.If) else [statement]:
            if _adds(node):
                text = ast.unparse(node.target)
                back = [one for one in ifs if text in assignments_in(one.body).assigned]
                if statement in back or (back and node is statement):
                    yield text, back


def _counted_by_objects(
    body: Sequence[ast.stmt], names: Mapping[str, Any], assigned: Collection[str], project: Project
) -> Iterator[str]:
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


def _adds(node: ast.stmt) -> TypeGuard[ast.AugAssign]:
    """Whether a statement adds a constant."""
    return isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add) and isinstance(node.value, ast.Constant)


def _counted(body: Sequence[ast.stmt]) -> Iterator[str]:
    assigned = assignments_in(body).assigned
    for node in unconditional(body):
        if _adds(node):
            text = ast.unparse(node.target)
            if assigned.count(text) == 1:
                yield text


def _always_reached(statement: ast.stmt) -> Iterator[ast.Call]:
    """Yield the calls in a statement that has no block, or in the condition of an `if`."""
    reached = statement.test if isinstance(statement, ast.If) else statement
    if isinstance(reached, (ast.expr, ast.Expr, ast.Assign, ast.AnnAssign)):
        yield from (part for part in ast.walk(reached) if isinstance(part, ast.Call))
