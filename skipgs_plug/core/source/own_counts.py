"""Functions of the user's that count how often they run, and decide by it: `self.calls += 1`, `if self.calls % 100`."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import CodeType, FunctionType, MethodType
from typing import Any

from skipgs_plug.core.source.assignments import assignments_in
from skipgs_plug.core.source.conditions import conditions_in, leaves
from skipgs_plug.core.source.counters import only_gathers
from skipgs_plug.core.source.evaluator import places_in
from skipgs_plug.core.source.functions import called_function, closure, syntax_of, undecorated, value_of
from skipgs_plug.core.source.inlining import MAX_DEPTH
from skipgs_plug.core.source.names import reached_in
from skipgs_plug.core.source.project import Project
from skipgs_plug.core.source.reach import compared, remainders
from skipgs_plug.core.source.run_options import text_of


def decisions_by_count(
    body: Sequence[ast.stmt], names: Mapping[str, Any], project: Project
) -> Iterator[tuple[ast.expr, CodeType]]:
    """Yield conditions on counters of functions that a loop calls, each with the code of its function.

    A counter keeps its value between calls, and gets a constant more in its function. If it is set back there, it
    decides by the condition under which it is. The functions need not receive the iteration's number.

    Args:
        body: The loop's statements.
        names: Names and values before the loop.
        project: The user's project. Other functions are not read.
    """
    seen: set[CodeType] = set()
    level: list[tuple[Sequence[ast.stmt], Mapping[str, Any]]] = [(body, names)]
    for _ in range(MAX_DEPTH):
        inside: list[tuple[Sequence[ast.stmt], Mapping[str, Any]]] = []
        for statements, known in level:
            for function, owner in _called(statements, known):
                syntax = syntax_of(function) if function in project and function.__code__ not in seen else None
                if syntax is not None:
                    seen.add(function.__code__)
                    yield from ((test, function.__code__) for test in _decisions(syntax))
                    first = [one.arg for one in syntax.args.args[:1] if owner is not None]
                    own = dict.fromkeys(first, owner)
                    inside.append((syntax.body, {**function.__globals__, **closure(function), **own}))
        level = inside


def _called(body: Iterable[ast.stmt], names: Mapping[str, Any]) -> Iterator[tuple[FunctionType, Any]]:
    """Yield the functions that statements call, and their decorators, with the objects whose methods they are."""

    def value(place: ast.expr) -> Any:
        return value_of(place, names, ())

    for node in (part for statement in body for part in reached_in(statement)):
        match node:
            case ast.Call(function):
                called = [function]
            case ast.withitem(held):
                called = [ast.Attribute(held, name, ast.Load()) for name in ("__enter__", "__exit__")]
            case _:
                continue
        for one in called:
            found = called_function(one, names, value)
            owner = found.__self__ if isinstance(found, MethodType) else None
            outer = found.__func__ if isinstance(found, MethodType) else found
            plain = {outer, undecorated(outer)} if isinstance(outer, FunctionType) else {undecorated(outer)}
            yield from ((function, owner) for function in plain if function is not None)


def _decisions(function: ast.FunctionDef) -> Iterator[ast.expr]:
    """Yield the conditions of a function on remainders or single values of its counters, or that set one back."""
    counted = _counted(function)
    assigned = assignments_in(function.body).assigned
    counts = {text for text in counted if assigned.count(text) == counted.count(text)}
    if counts:
        for condition in conditions_in(function.body, {}):
            for leaf in leaves(condition.test):
                if any(places_in(one) & counts for one in (*remainders(leaf), *compared(leaf))):
                    yield leaf
    for node in ast.walk(function):
        if isinstance(node, ast.If) and not only_gathers(node):
            back = {*counted}.difference(counts).intersection(assignments_in(node.body).assigned)
            yield from (leaf for leaf in leaves(node.test) if places_in(leaf) & back)


def _counted(function: ast.FunctionDef) -> list[str]:
    """Return the places of a function that keep their values between calls, once for each constant that it adds."""
    nodes = [*ast.walk(function)]
    shared = {name for node in nodes if isinstance(node, (ast.Global, ast.Nonlocal)) for name in node.names}
    added = [
        node.target
        for node in nodes
        if isinstance(node, ast.AugAssign) and isinstance(node.op, (ast.Add, ast.Sub)) and _is_number(node.value)
    ]
    return [text_of(one) for one in added if not isinstance(one, ast.Name) or one.id in shared]


def _is_number(value: ast.expr) -> bool:
    return isinstance(value, ast.Constant) and isinstance(value.value, (int, float))
