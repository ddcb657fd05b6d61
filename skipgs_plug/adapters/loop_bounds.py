"""The iteration after which a training loop no longer calls a method, read from its conditions."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

NUMBER = "iteration"  # the loop's variable in the whole Inria family


def last_calls(function: ast.FunctionDef, names: Collection[str], values: Mapping[str, Any]) -> dict[str, int]:
    """Return the first iteration that is too late for each of these calls, for calls that end at some iteration.

    A call ends when an `if` around it bounds the iteration from above by something that is known when the loop begins,
    as in `iteration < opt.prune_until_iter`, `iteration == 300` or `iteration in args.prune_iterations`. Where a
    method is called in several places, the latest end counts; a place without an end leaves the method out.

    Args:
        function: The function that holds the loop.
        names: Names of the methods.
        values: Names of the loop and their values when it begins.
    """
    ends: dict[str, int | None] = {}
    for name, end in _calls(function.body, None, values):
        if name in names:
            before = ends.get(name, 0)
            ends[name] = None if end is None or before is None else max(before, end)
    return {name: end for name, end in ends.items() if end is not None}


def function_of(source: Path | Any, name: str) -> ast.FunctionDef | None:
    """Return the function of this name in a script, or the syntax of a function; None where there is no source."""
    try:
        text = source.read_bytes() if isinstance(source, Path) else textwrap.dedent(inspect.getsource(source))
        tree = ast.parse(text)
    except (OSError, TypeError, ValueError, SyntaxError):
        return None
    return next((node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name), None)


def _calls(body: list[ast.stmt], end: int | None, values: Mapping[str, Any]) -> Iterator[tuple[str, int | None]]:
    """Yield the name of each method that is called, and the first iteration that is too late for it."""
    for statement in body:
        if isinstance(statement, ast.If):
            own = _end(statement.test, values)
            yield from _calls(statement.body, end if own is None else own if end is None else min(own, end), values)
            yield from _calls(statement.orelse, end, values)
            continue
        blocks = [block for field in ("body", "orelse", "finalbody") for block in getattr(statement, field, [])]
        blocks += [inner for handler in getattr(statement, "handlers", []) for inner in handler.body]
        yield from _calls(blocks, end, values)
        inside = {id(node) for block in blocks for node in ast.walk(block)}
        for node in ast.walk(statement):
            if id(node) not in inside and isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                yield node.func.attr, end


def _end(test: ast.expr, values: Mapping[str, Any]) -> int | None:
    """First iteration from which a condition is false for good; None where that is not known."""
    if isinstance(test, ast.BoolOp):
        ends = [_end(part, values) for part in test.values]
        known = [end for end in ends if end is not None]
        if isinstance(test.op, ast.And):
            return min(known, default=None)
        return max(known) if len(known) == len(ends) else None
    if not isinstance(test, ast.Compare):
        return None
    sides = [test.left, *test.comparators]
    limits = [
        end
        for left, operator, right in zip(sides, test.ops, sides[1:], strict=False)
        if (end := _end_of_one(left, operator, right, values)) is not None
    ]
    return min(limits, default=None)


def _end_of_one(left: ast.expr, operator: ast.cmpop, right: ast.expr, values: Mapping[str, Any]) -> int | None:
    if _is_number(right) and isinstance(operator, (ast.Gt, ast.GtE, ast.Eq)):  # X > iteration
        left, right = right, left
        operator = {ast.Gt: ast.Lt, ast.GtE: ast.LtE, ast.Eq: ast.Eq}[type(operator)]()
    if not _is_number(left):
        return None
    limit = _value(right, values)
    if isinstance(operator, ast.In) and isinstance(limit, (list, tuple, set, frozenset, range)):
        return max((int(number) for number in limit), default=0) + 1
    if isinstance(limit, bool) or not isinstance(limit, (int, float)):
        return None
    if isinstance(operator, ast.Lt):
        return int(-(-limit // 1))
    if isinstance(operator, (ast.LtE, ast.Eq)):
        return int(limit) + 1
    return None


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id == NUMBER


def _value(node: ast.expr, values: Mapping[str, Any]) -> Any:
    """Value of an expression of names, attributes and numbers; None for anything else."""
    allowed = (ast.Name, ast.Attribute, ast.Constant, ast.BinOp, ast.UnaryOp, ast.List, ast.Tuple)
    leaves = (ast.expr_context, ast.operator, ast.unaryop)
    if not all(isinstance(part, (*allowed, *leaves)) for part in ast.walk(node)) or NUMBER in _names(node):
        return None
    try:
        return eval(compile(ast.Expression(node), "<condition>", "eval"), {"__builtins__": {}}, values)
    except Exception:
        return None


def _names(node: ast.expr) -> set[str]:
    return {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
