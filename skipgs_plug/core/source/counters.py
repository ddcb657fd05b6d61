"""Counters of a loop: names and attributes that count the iterations that run, as `images += 1` does."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from types import MethodType
from typing import Any

from skipgs_plug.core.source.assignments import assignments_in
from skipgs_plug.core.source.conditions import unconditional
from skipgs_plug.core.source.evaluator import places_in
from skipgs_plug.core.source.functions import called_function, syntax_of, undecorated, value_of
from skipgs_plug.core.source.names import counted_by
from skipgs_plug.core.source.project import Project
from skipgs_plug.core.source.run_options import PURE

# Functions and methods that end the gathering of gradients over a few iterations. Such a loop loses nothing if its
# optimizers step after as many iterations that run.
_ENDS_GATHERING = PURE | {"clip_grad_norm_", "parameters", "step", "unscale_", "update", "zero_grad"}


def counters(
    body: Sequence[ast.stmt], names: Mapping[str, Any], assigned: Collection[str], project: Project
) -> tuple[set[str], list[ast.If]]:
    """Return what a loop changes by a constant in every iteration: names, attributes and lengths.

    They are those of the loop, and those of objects that the loop calls in every iteration, as in `saver.count()`, or
    in `is_due()` for an object that can be called. The loop may set its own back, as PUP 3D-GS does at each prune.

    Args:
        body: The loop's statements.
        names: Names and values before the loop.
        assigned: Names and attributes that the loop assigns.
        project: The user's project. Methods of libraries are not read.

    Returns:
        The counters, and the statements under whose conditions one is set back.
    """
    own = [text for text in _counted(body) if not _is_limited(text, names)]
    back = dict(_set_back(body))
    ifs = [one for statements in back.values() for one in statements]
    return {*back, *own, *_counted_by_objects(body, names, assigned, project)}, ifs


def only_gathers(statement: ast.If) -> bool:
    """Whether a statement under which a counter is set back does no more than end a gathering over a few iterations."""
    calls = [part.func for one in statement.body for part in ast.walk(one) if isinstance(part, ast.Call)]
    return all(getattr(called, "attr", getattr(called, "id", None)) in _ENDS_GATHERING for called in calls)


def _set_back(body: Sequence[ast.stmt]) -> Iterator[tuple[str, list[ast.If]]]:
    """Yield the counters that a loop sets back, each with the statements under which it does so."""
    ifs = [part for statement in body for part in ast.walk(statement) if isinstance(part, ast.If)]
    for statement in unconditional(body):
        for node in unconditional(statement.orelse) if isinstance(statement, ast.If) else [statement]:
            if (text := _counts(node)) is not None:
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
                own = rf"(len\()?{syntax.args.args[0].arg}\."
                owner = ast.unparse(called).removesuffix(f".{syntax.name}")  # an object that is called has no suffix
                parts = ((re.match(own, text), text) for text in _counted(syntax.body))
                yield from (f"{found[1] or ''}{owner}.{text[found.end() :]}" for found, text in parts if found)


def counts_in(expression: ast.expr) -> set[str]:
    """Return the names, attributes, entries and lengths that an expression reads, as source text."""
    parts = (part for part in ast.walk(expression) if isinstance(part, ast.Call))
    return places_in(expression).union(text for text in map(ast.unparse, parts) if text.startswith("len("))


def _counts(node: ast.stmt) -> str | None:
    """Return what a statement changes by a constant, as source text; None for any other statement."""
    match node:
        case ast.AugAssign(target, ast.Add() | ast.Sub(), ast.Constant()):
            return ast.unparse(target)
        case ast.Assign([target], ast.BinOp(before, ast.Add() | ast.Sub(), ast.Constant())):
            return ast.unparse(target) if ast.unparse(target) == ast.unparse(before) else None
    return None


def _counted(body: Sequence[ast.stmt]) -> Iterator[str]:
    found, own = assignments_in(body), [*unconditional(body)]
    for text in map(_counts, own):
        if text is not None and found.assigned.count(text) == 1:
            yield text
    for held in map(_growing, own):
        if held is not None and held not in found.shrunk.union(found.assigned):
            yield f"len({held})"


def _is_limited(counter: str, names: Mapping[str, Any]) -> bool:
    """Whether this is the length of a queue that drops its first entry when it is full."""
    place = ast.parse(counted_by(counter), mode="eval").body
    return getattr(value_of(place, names, ()), "maxlen", None) is not None


def _growing(statement: ast.stmt) -> str | None:
    """Return the list, queue or set to which a statement adds one entry, as source text; None for any other one."""
    match statement:
        case ast.Expr(ast.Call(ast.Attribute(held, "add" | "append" | "appendleft" | "insert"))):
            return ast.unparse(held)
    return None


def _always_reached(statement: ast.stmt) -> Iterator[ast.Call]:
    """Yield the calls in a statement that has no block, or in the condition of an `if`."""
    reached = statement.test if isinstance(statement, ast.If) else statement
    if isinstance(reached, (ast.expr, ast.Expr, ast.Assign, ast.AnnAssign)):
        yield from (part for part in ast.walk(reached) if isinstance(part, ast.Call))
