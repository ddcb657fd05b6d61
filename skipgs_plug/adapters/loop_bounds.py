"""Find the calls of a training loop, and the iteration after which the loop no longer makes each call.

Both are read from the source of the loop and of the functions of the same project that it calls.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import textwrap
from collections import ChainMap, Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

from skipgs_plug.core.pace.called import called, syntax_of, undecorated

NUMBER = "iteration"  # variable that holds the iteration's number in every loop of the Inria family
ASSIGNED = "data ="  # represents an assignment to a tensor's `data` among the names of calls
# Functions that conditions may call while they are evaluated, because the functions change nothing.
PURE = {name: getattr(builtins, name) for name in ("abs", "int", "float", "len", "max", "min", "round")}
# Largest depth of nested calls that are read. A trainer's loop reaches its strategy in three; deeper calls reach
# libraries.
MAX_DEPTH = 5
_NEGATED = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}
_MIRRORED = {ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Gt: ast.Lt, ast.GtE: ast.LtE, ast.Eq: ast.Eq}


class Scope(NamedTuple):
    """The names that a function can use.

    Attributes:
        numbers: Expressions that hold the iteration's number, as spelled by `ast.unparse`.
        values: Values of names when the loop begins.
        code: Code of the function; None for the loop of a script.
    """

    numbers: frozenset[str]
    values: Mapping[str, Any]
    code: CodeType | None = None


class CallReader:
    """Reads functions and records the end of every call in them.

    A call has an end if an `if` around it bounds the iteration's number from above by a value that is known when the
    loop begins, as in `iteration < opt.prune_until_iter`, `iteration == 300` or `iteration in args.prune_iterations`. A
    guard before the call has the same effect: `if step >= self.stop: return`.

    Args:
        projects: Top-level packages whose functions are read if a function calls them. Callers may add more.
        stops: Names of functions that are not read.
        windows: Names of functions `f(number, start, end, ...)` that return whether a number lies between two others.
            With a negative start it never does; with a negative end there is no end.

    Attributes:
        ends: By the name of each call, the first iteration in which the loop no longer makes the call. If a name is
            called in several places, the latest end counts; None if one of the places has no end.
        projects: The given packages, and those that callers added.
    """

    def __init__(self, projects: Iterable[str] = (), stops: Iterable[str] = (), windows: Iterable[str] = ()) -> None:
        self.ends: dict[str, int | None] = {}
        self.projects, self._stops = set(projects), frozenset(stops)
        self._windows = frozenset(windows)
        self._open: list[CodeType] = []  # code of the functions that are being read, outermost first

    def read(self, function: Any, numbers: Collection[str], values: Mapping[str, Any], end: int | None = None) -> None:
        """Read a function or a bound method.

        Args:
            function: The function. It is ignored if it has no Python source.
            numbers: Expressions that hold the iteration's number inside the function.
            values: Known values of its arguments.
            end: First iteration in which the loop no longer calls the function; None if it is called until the end
                of the run.
        """
        plain = undecorated(function)
        syntax = None if plain is None else syntax_of(plain)
        if plain is None or syntax is None or plain.__code__ in self._open or len(self._open) == MAX_DEPTH:
            return
        owner = getattr(function, "__self__", None)
        if owner is not None and syntax.args.args:
            values = {syntax.args.args[0].arg: owner, **values}
        self._open.append(plain.__code__)
        names = ChainMap(dict(values), plain.__globals__)
        self.read_body(syntax, Scope(frozenset(numbers), names, plain.__code__), end)
        self._open.pop()

    def read_body(self, syntax: ast.FunctionDef, scope: Scope, end: int | None = None) -> None:
        """Read the body of a function; `end` has the same meaning as in `read`."""
        stores = Counter(
            node.id for node in ast.walk(syntax) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        )
        known: dict[str, Any] = {}  # names that are assigned only once, from known values
        scope = scope._replace(values=ChainMap(known, *_maps(scope.values)))
        self._body(syntax.body, scope, end, stores, known)

    def _body(
        self, body: list[ast.stmt], scope: Scope, end: int | None, stores: Counter[str], known: dict[str, Any]
    ) -> None:
        if end == 0:  # the body is never reached
            return
        for statement in body:
            if isinstance(statement, ast.If):
                self._calls(statement.test, scope, end)
                inside = _sooner(end, self._end(statement.test, scope))
                after = _sooner(end, self._end(statement.test, scope, holds=False))
                self._body(statement.body, scope, inside, stores, known)
                self._body(statement.orelse, scope, after, stores, known)
                if isinstance(statement.body[-1], (ast.Return, ast.Continue)):
                    end = after
                continue
            blocks = [block for field in ("body", "orelse", "finalbody") for block in getattr(statement, field, [])]
            blocks += [inner for handler in getattr(statement, "handlers", []) for inner in handler.body]
            blocks += [inner for case in getattr(statement, "cases", []) for inner in case.body]
            if isinstance(statement, (ast.Assign, ast.AnnAssign)):
                self._assign(statement, scope, stores, known)
            self._calls(statement, scope, end, {id(node) for block in blocks for node in ast.walk(block)})
            self._body(blocks, scope, end, stores, known)

    def _assign(
        self, statement: ast.Assign | ast.AnnAssign, scope: Scope, stores: Counter[str], known: dict[str, Any]
    ) -> None:
        match statement:
            case ast.Assign([ast.Name(name)], value) | ast.AnnAssign(ast.Name(name), _, ast.expr() as value):
                found = _value(value, scope)
                if stores[name] == 1 and found is not None:
                    known[name] = found

    def _calls(self, part: ast.AST, scope: Scope, end: int | None, but: Collection[int] = ()) -> None:
        """Record the calls in a statement or expression, except the nodes `but`, and read the called functions."""
        for node in ast.walk(part):
            if id(node) in but:
                continue
            if isinstance(node, ast.Attribute) and node.attr == "data" and isinstance(node.ctx, ast.Store):
                self.note(ASSIGNED, end)
            elif isinstance(node, ast.Call):
                name = getattr(node.func, "attr", getattr(node.func, "id", None))
                if name is not None:
                    self.note(name, end)
                    self._follow(name, node, scope, end)

    def note(self, name: str, end: int | None) -> None:
        """Record a call that the loop no longer makes from iteration `end` on; None if the call has no end."""
        before = self.ends.get(name, 0)
        self.ends[name] = None if end is None or before is None else max(before, end)

    def _follow(self, name: str, call: ast.Call, scope: Scope, end: int | None) -> None:
        if not self.projects or name in self._stops:
            return
        function = called(call.func, scope.values, lambda place: _value(place, scope), scope.code)
        plain = undecorated(function)
        syntax = None if plain is None else syntax_of(plain)
        if plain is None or syntax is None or str(plain.__module__).partition(".")[0] not in self.projects:
            return
        owner = getattr(function, "__self__", None)
        parameters = [one.arg for one in syntax.args.args][owner is not None :]
        given = [*zip(parameters, call.args, strict=False), *((one.arg, one.value) for one in call.keywords if one.arg)]
        numbers = {parameter for parameter, value in given if ast.unparse(value) in scope.numbers}
        # Attributes of the object have the same name in all of its methods.
        numbers |= {text for text in scope.numbers if text.startswith("self.") and owner is scope.values.get("self")}
        values = {parameter: _value(value, scope) for parameter, value in given if parameter not in numbers}
        self.read(function, numbers, {text: value for text, value in values.items() if value is not None}, end)

    def _end(self, test: ast.expr, scope: Scope, holds: bool = True) -> int | None:
        """Return the first iteration from which a condition stays false (true, unless `holds`); None if unknown."""
        match test:
            case ast.UnaryOp(ast.Not(), operand):
                return self._end(operand, scope, not holds)
            case ast.BoolOp(operator, parts):
                ends = [self._end(part, scope, holds) for part in parts]
                known = [end for end in ends if end is not None]
                if isinstance(operator, ast.And) is holds:
                    return min(known, default=None)
                return max(known) if len(known) == len(ends) else None
            case ast.Compare(option, [ast.Is() | ast.IsNot()], [ast.Constant(None)]):
                # Whether an option is set does not change during the run, so the call is never made.
                return 0 if _is_plain_place(option) and _evaluated(test, scope) is (not holds) else None
            case ast.Compare(left, [operator], [right]) if not holds:
                negated = _NEGATED.get(type(operator))
                return None if negated is None else _end_of_one(left, negated(), right, scope)
            case ast.Compare(left, operators, others) if holds:
                sides = [left, *others]
                limits = [_end_of_one(*one, scope) for one in zip(sides, operators, others, strict=False)]
                return min((end for end in limits if end is not None), default=None)
            case ast.Call(ast.Name(name), [number, first, last, *_]) if holds and name in self._windows:
                start, end = _value(first, scope), _value(last, scope)
                if ast.unparse(number) not in scope.numbers or not isinstance(start, int) or not isinstance(end, int):
                    return None
                return 0 if start < 0 else end if end >= 0 else None
        return None


def last_calls(function: ast.FunctionDef, names: Collection[str], values: Mapping[str, Any]) -> dict[str, int]:
    """Return the first iteration in which the loop no longer makes each of these calls, for calls that have an end.

    Functions of the loop's own package or script are read too.

    Args:
        function: The function that holds the loop.
        names: Names of the methods.
        values: Values of the loop's names when it begins.
    """
    reader = CallReader(projects={str(values.get("__name__", "__main__")).partition(".")[0]}, stops=names)
    reader.read_body(function, Scope(frozenset({NUMBER}), values))
    return {name: end for name, end in reader.ends.items() if name in names and end is not None}


def function_of(source: Path | Any, name: str) -> ast.FunctionDef | None:
    """Return the syntax of a function, from a script or from the function itself; None if there is no source."""
    try:
        text = source.read_bytes() if isinstance(source, Path) else textwrap.dedent(inspect.getsource(source))
        tree = ast.parse(text)
    except (OSError, TypeError, ValueError, SyntaxError):
        return None
    return next((node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name), None)


def _sooner(one: int | None, other: int | None) -> int | None:
    return one if other is None else other if one is None else min(one, other)


def _maps(values: Mapping[str, Any]) -> list[Any]:
    return values.maps if isinstance(values, ChainMap) else [values]


def _end_of_one(left: ast.expr, operator: ast.cmpop, right: ast.expr, scope: Scope) -> int | None:
    if ast.unparse(right) in scope.numbers and type(operator) in _MIRRORED:  # X > iteration
        left, right = right, left
        operator = _MIRRORED[type(operator)]()
    if ast.unparse(left) not in scope.numbers:
        return None
    limit = _value(right, scope)
    if isinstance(operator, ast.In) and isinstance(limit, (list, tuple, set, frozenset, range)):
        return max((int(number) for number in limit), default=0) + 1
    if isinstance(limit, bool) or not isinstance(limit, (int, float)) or not math.isfinite(limit):
        return None
    if isinstance(operator, ast.Lt):
        return math.ceil(limit)
    if isinstance(operator, (ast.LtE, ast.Eq)):
        return math.floor(limit) + 1
    return None


def _value(node: ast.expr, scope: Scope) -> Any:
    """Return the value of an expression of names, attributes, constants, operators and `PURE` functions; else None."""
    if not all(_is_plain(part) for part in ast.walk(node)) or any(text in scope.numbers for text in _places(node)):
        return None
    return _evaluated(node, scope)


def _evaluated(node: ast.expr, scope: Scope) -> Any:
    try:
        return eval(compile(ast.Expression(node), "<condition>", "eval"), {"__builtins__": PURE}, scope.values)
    except Exception:
        return None


def _is_plain_place(node: ast.expr) -> bool:
    return all(isinstance(part, (ast.Name, ast.Attribute, ast.expr_context)) for part in ast.walk(node))


def _is_plain(part: ast.AST) -> bool:
    if isinstance(part, ast.Call):
        return isinstance(part.func, ast.Name) and part.func.id in PURE and not part.keywords
    allowed = (ast.Name, ast.Attribute, ast.Constant, ast.BinOp, ast.UnaryOp, ast.List, ast.Tuple)
    return isinstance(part, (*allowed, ast.expr_context, ast.operator, ast.unaryop))


def _places(node: ast.expr) -> Iterator[str]:
    return (ast.unparse(part) for part in ast.walk(node) if isinstance(part, (ast.Name, ast.Attribute)))
