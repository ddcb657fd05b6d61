"""The names in a training loop: their values when it begins, and the expressions that they stand for."""

from __future__ import annotations

import ast
import builtins
import dataclasses
from collections import ChainMap, Counter
from collections.abc import Iterator, Mapping
from types import CodeType
from typing import Any, NamedTuple

from skipgs_plug.core.source.run_options import PURE, is_namespace, is_plain
from skipgs_plug.core.source.substitution import assigned_values

_PURE = {name: getattr(builtins, name) for name in PURE}
NOTHING: dict[str, Any] = {}  # stands for the names of a function that was not read yet


class Scope(NamedTuple):
    """The names that a function can use.

    Attributes:
        numbers: Expressions that hold the iteration's number, as spelled by `ast.unparse`.
        values: Values of names when the loop begins.
        code: Code of the function; None for the loop of a script.
        once: Names and attributes that the function assigns in one place only.
        own: Parameters of the function, and all names that it assigns.
        varying: Names and attributes that iterations assign, so that `values` may hold another iteration's.
        known: Values of names in `once`, after they were assigned.
        meanings: Expressions for which names in `once` stand, after they were assigned. Attributes are among them if
            they hold the iteration's number.
    """

    numbers: frozenset[str]
    values: Mapping[str, Any]
    code: CodeType | None = None
    once: frozenset[str] = frozenset()
    own: frozenset[str] = frozenset()
    varying: frozenset[str] = frozenset()
    known: dict[str, Any] = NOTHING
    meanings: dict[str, ast.expr] = NOTHING


def scope_inside(function: ast.FunctionDef, scope: Scope) -> Scope:
    """Return the scope at the beginning of a function."""
    maps = scope.values.maps if isinstance(scope.values, ChainMap) else [scope.values]
    names, attributes = Counter(stored(function)), Counter(stored(function, ast.Attribute))
    in_loops = {name for loop in outermost_loops(function) for name in stored(loop)}
    arguments = function.args
    parameters = {one.arg for one in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)}
    known: dict[str, Any] = {}
    return scope._replace(
        values=ChainMap(known, *maps),
        once=frozenset(place for place, count in (names + attributes).items() if count == 1),
        own=frozenset(parameters | names.keys()),
        varying=frozenset(in_loops.union(names.keys() - maps[0].keys(), attributes)),
        known=known,
        meanings={},
    )


def learn_names(statement: ast.stmt, scope: Scope) -> None:
    """Record the names that a statement assigns, with their values and the expressions that they stand for."""
    for target, value in assigned_values(statement):
        if isinstance(target, ast.Name) and target.id in scope.once:
            found = value_of(value, scope)
            if found is not None:
                scope.known[target.id] = found
            scope.meanings[target.id] = value
        elif ast.unparse(target) in scope.once and offset_of(value, scope) is not None:  # self.step = step
            scope.meanings[ast.unparse(target)] = value


def named(name: str, value: Any, scope: Scope) -> ast.expr:
    """Give a value a name, and return the name as an expression."""
    scope.known[name] = value
    return ast.Name(name, ast.Load())


def value_of(node: ast.expr, scope: Scope) -> Any:
    """Return the value of an expression of names, attributes, constants, operators and `PURE` functions; else None."""
    unknown = scope.numbers | scope.varying.difference(scope.known)
    if not all(_is_plain(part) for part in ast.walk(node)) or unknown.intersection(_places(node)):
        return None
    return evaluated(node, scope)


def evaluated(node: ast.expr, scope: Scope, otherwise: Any = None) -> Any:
    """Return the value of an expression, or `otherwise` if it has none."""
    try:
        return eval(compile(ast.Expression(node), "<condition>", "eval"), {"__builtins__": _PURE}, scope.values)
    except Exception:
        return otherwise


def is_option(node: ast.expr, scope: Scope) -> bool:
    """Whether an expression consists of options: plain values that are the same in all iterations."""
    match node:
        case ast.Constant():
            return True
        case ast.Name(name) if name in scope.meanings:
            return is_option(scope.meanings[name], without(name, scope))
        case ast.Name(name):
            return name in scope.own - scope.varying and name in scope.values and is_plain(scope.values[name])
        case ast.Attribute(place, name) if ast.unparse(node) not in scope.varying:
            holder = value_of(place, scope)
            holds = is_namespace(holder) or dataclasses.is_dataclass(holder)
            return holds and hasattr(holder, name) and is_plain(getattr(holder, name))
        case ast.Call(ast.Name("getattr"), [place, ast.Constant(str(name)), *default]):
            attribute, holder = ast.Attribute(place, name, ast.Load()), value_of(place, scope)
            absent = bool(default) and holder is not None and not hasattr(holder, name)
            return is_option(default[0] if absent else attribute, scope)
        case ast.BoolOp() | ast.BinOp() | ast.UnaryOp() | ast.Compare() | ast.IfExp() | ast.Tuple() | ast.List():
            return all(is_option(part, scope) for part in ast.iter_child_nodes(node) if isinstance(part, ast.expr))
    return False


def offset_of(node: ast.expr, scope: Scope) -> int | None:
    """Return the difference between an expression and the iteration's number; None if it is not constant."""
    if ast.unparse(node) in scope.numbers:
        return 0
    match node:
        case ast.Name() | ast.Attribute() if (place := ast.unparse(node)) in scope.meanings:
            return offset_of(scope.meanings[place], without(place, scope))
        case ast.NamedExpr(_, value):
            return offset_of(value, scope)
        case ast.BinOp(place, ast.Add() | ast.Sub() as sign, ast.Constant(int(by))):
            before = offset_of(place, scope)
            return None if before is None else before + by * (1 if isinstance(sign, ast.Add) else -1)
    return None


def without(name: str, scope: Scope) -> Scope:
    """Return the scope for the expression that a name stands for. It cannot contain the name itself."""
    return scope._replace(meanings={other: value for other, value in scope.meanings.items() if other != name})


def stored(part: ast.AST, kind: type[ast.Name | ast.Attribute] = ast.Name) -> list[str]:
    """Return the names, or the attributes, that a part of a source assigns, as often as it does."""
    places = (node for node in ast.walk(part) if isinstance(node, kind) and isinstance(node.ctx, ast.Store))
    return [ast.unparse(place) for place in places]


def outermost_loops(node: ast.AST) -> Iterator[ast.For | ast.While]:
    """Yield the loops inside a function that are not inside another loop."""
    for part in ast.iter_child_nodes(node):
        if isinstance(part, (ast.For, ast.While)):
            yield part
        elif not isinstance(part, (ast.FunctionDef, ast.ClassDef)):
            yield from outermost_loops(part)


def _is_plain(part: ast.AST) -> bool:
    if isinstance(part, ast.Call):
        return isinstance(part.func, ast.Name) and part.func.id in PURE and not part.keywords
    names = (ast.Name, ast.Attribute, ast.Constant, ast.List, ast.Tuple, ast.expr_context)
    operators = (ast.BinOp, ast.UnaryOp, ast.Compare, ast.BoolOp, ast.IfExp)
    return isinstance(part, (*names, *operators, ast.operator, ast.unaryop, ast.cmpop, ast.boolop))


def _places(node: ast.expr) -> Iterator[str]:
    """Yield the names and attributes in an expression, also those of `getattr(place, "name")`."""
    for part in ast.walk(node):
        match part:
            case ast.Name() | ast.Attribute():
                yield ast.unparse(part)
            case ast.Call(ast.Name("getattr"), [place, ast.Constant(str(name)), *_]):
                yield f"{ast.unparse(place)}.{name}"
