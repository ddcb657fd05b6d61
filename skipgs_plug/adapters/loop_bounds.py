"""Find the calls of a training loop, and the iteration after which the loop no longer makes each call.

Both are read from the source of the loop and of the trainer's functions that it calls.
"""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from collections import ChainMap
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import torch

from skipgs_plug.adapters.gradient_checks import checked_gradients, expects_none
from skipgs_plug.adapters.loop_names import (
    Scope,
    evaluated,
    is_option,
    learn_names,
    named,
    offset_of,
    outermost_loops,
    scope_inside,
    stored,
    value_of,
    without,
)
from skipgs_plug.adapters.trainer_code import Part, TrainerCode
from skipgs_plug.core.source.conditions import case_test
from skipgs_plug.core.source.functions import (
    callbacks,
    called_function,
    closure,
    syntax_of,
    undecorated,
    without_partial,
)
from skipgs_plug.core.source.substitution import returned

# They represent uses of attributes among the names of calls: assignments to a tensor's `data` and to the options that
# end densification, and reads of a tensor's gradient by code that does not expect that there may be none.
ASSIGNED, SETS_END, READS_GRADIENT = "data =", "end of densification =", ".grad"
_USES = {
    ("data", ast.Store): ASSIGNED,
    ("densify_until_iter", ast.Store): SETS_END,
    ("refine_stop_iter", ast.Store): SETS_END,
    ("grad", ast.Load): READS_GRADIENT,
    ("absgrad", ast.Load): READS_GRADIENT,
}
# Largest depth of nested calls that are read. A trainer's loop reaches its strategy in three; deeper calls reach
# libraries.
MAX_DEPTH = 5
_NEGATED = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.NotEq: ast.Eq,
    ast.NotIn: ast.In,
}
_MIRRORED = {ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Gt: ast.Lt, ast.GtE: ast.LtE, ast.Eq: ast.Eq}


class CallReader:
    """Reads functions and records the end of every call in them.

    A call has an end if an `if` around it bounds the iteration's number from above by a value that is known when the
    loop begins, as in `iteration < opt.prune_until_iter`, `iteration == 300` or `iteration in args.prune_iterations`. A
    guard before the call has the same effect: `if step >= self.stop: return`. An option that is off ends all calls
    behind it. A name that is assigned once stands for its expression: `late = iteration in (300, 600)`, `if late`. So
    does a call of a function that only returns a condition.

    Args:
        stops: Names of functions of which only the reads of gradients count.
        gated: Names of the functions whose backward may be skipped. That of any other function always runs.
        windows: Names of functions `f(number, start, end, ...)` that return whether a number lies between two others.
            With a negative start it never does; with a negative end there is no end.

    Attributes:
        ends: By the name of each call, the first iteration in which the loop no longer makes the call. If a name is
            called in several places, the latest end counts; None if one of the places has no end.
        asked: Attributes that the loop may read, and texts, which can name attributes.
        passed_over: The same for parts that the loop never reaches, and for the conditions that keep it from them.
        trainer: Functions of this code are read if a function calls them. Callers add to it.
    """

    def __init__(self, stops: Iterable[str] = (), gated: Iterable[str] = (), windows: Iterable[str] = ()) -> None:
        self.ends: dict[str, int | None] = {}
        self.asked: set[str] = set()
        self.passed_over: set[str] = set()
        self.trainer = TrainerCode()
        self._stops, self._gated, self._windows = frozenset(stops), frozenset(gated), frozenset(windows)
        self._open: list[CodeType] = []  # code of the functions that are being read, outermost first
        # Whether reads of gradients need no training backward here: a condition around or before them compares a
        # gradient with None, or a function around them has run a backward of its own.
        self._gradient_safe = False
        self._only_gradients = False  # inside a function of `stops`
        self._checked: set[ast.expr] = set()  # gradients that functions compare with None

    def reaches(self, name: str) -> bool:
        """Whether the loop may call a method of this name, or assign to `data`, in some iteration.

        A method that the reader has not met may be called by code that it could not follow.
        """
        called = ASSIGNED if name == "data" else name
        return called in self.ends or name not in self.passed_over

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
        outer = self._gradient_safe
        self._checked.update(checked_gradients(syntax))
        self._open.append(plain.__code__)
        self._body(syntax.body, self._scope(function, plain, syntax, numbers, values), end)
        self._open.pop()
        self._gradient_safe = outer

    @staticmethod
    def _scope(
        function: Any, plain: FunctionType, syntax: ast.FunctionDef, numbers: Collection[str], values: Mapping[str, Any]
    ) -> Scope:
        """Return the scope at the beginning of a function; arguments as for `read`."""
        owner = getattr(function, "__self__", None)
        if owner is not None and syntax.args.args:
            values = {syntax.args.args[0].arg: owner, **values}
        names = ChainMap({**closure(plain), **values}, plain.__globals__)
        return scope_inside(syntax, Scope(frozenset(numbers), names, plain.__code__))

    def read_loops(self, function: ast.FunctionDef, scope: Scope) -> None:
        """Read the loops of a function, or all of it if it has none."""
        scope = scope_inside(function, scope)
        self._checked.update(checked_gradients(function))
        for body in [loop.body for loop in outermost_loops(function)] or [function.body]:
            self._body(body, scope, None)

    def _body(self, body: list[ast.stmt], scope: Scope, end: int | None) -> None:
        if end == 0:  # the body is never reached
            for statement in body:
                self._ask(statement, self.passed_over)
            return
        for statement in body:
            if isinstance(statement, (ast.If, ast.While)):
                self._calls(statement.test, scope, end)
                inside = _sooner(end, self._end(statement.test, scope))
                decides = inside != 0 or statement.orelse
                self._ask(statement.test, self.asked if decides else self.passed_over)
                after = _sooner(end, self._end(statement.test, scope, holds=False))
                outer, self._gradient_safe = self._gradient_safe, self._gradient_safe or expects_none(statement.test)
                self._body(statement.body, scope, inside)
                self._body(statement.orelse, scope, after)
                if isinstance(statement, ast.If) and isinstance(statement.body[-1], (ast.Return, ast.Continue)):
                    end = after
                elif expects_none(statement.test):
                    self._gradient_safe = outer
                continue
            if isinstance(statement, ast.Match):
                self._ask(statement.subject, self.asked)
                self._calls(statement.subject, scope, end)
                for case in statement.cases:
                    test = case_test(statement.subject, case)
                    self._ask(test, self.asked)
                    self._body(case.body, scope, _sooner(end, self._end(test, scope)))
                continue
            if isinstance(statement, ast.For) and self._each(statement, scope, end):
                continue
            blocks = [block for field in ("body", "orelse", "finalbody") for block in getattr(statement, field, [])]
            blocks += [inner for handler in getattr(statement, "handlers", []) for inner in handler.body]
            learn_names(statement, scope)
            inner = {id(node) for block in blocks for node in ast.walk(block)}
            self._ask(statement, self.asked, inner)
            self._calls(statement, scope, end, inner)
            self._body(blocks, scope, end)

    def _calls(self, part: ast.AST, scope: Scope, end: int | None, but: Collection[int] = ()) -> None:
        """Record the calls in a statement or expression, except the nodes `but`, and read the called functions."""
        if id(part) in but or end == 0:
            return
        if isinstance(part, ast.BoolOp):
            for value in part.values:
                self._calls(value, scope, end)
                end = _sooner(end, self._end(value, scope, holds=isinstance(part.op, ast.And)))
            return
        if isinstance(part, ast.IfExp):
            self._calls(part.test, scope, end)
            self._calls(part.body, scope, _sooner(end, self._end(part.test, scope)))
            self._calls(part.orelse, scope, _sooner(end, self._end(part.test, scope, holds=False)))
            return
        if isinstance(part, ast.Attribute) and (use := _USES.get((part.attr, type(part.ctx)))) is not None:
            # `absgrad` is also the name of an option, which MCMC's strategy does not have.
            owner = value_of(part.value, scope)
            is_option = owner is not None and not isinstance(owner, torch.Tensor)
            safe = self._gradient_safe or part in self._checked or is_option
            if use != READS_GRADIENT or not safe:
                self.note(use, end)
        elif isinstance(part, ast.Call):
            name = getattr(part.func, "attr", getattr(part.func, "id", None))
            if name == "backward" and self._open and self._open[-1].co_name not in self._gated:
                self._gradient_safe = True
            elif name is not None:
                self.note(name, end)
                self._follow(name, part, scope, end)
        for child in ast.iter_child_nodes(part):
            self._calls(child, scope, end, but)

    def _each(self, loop: ast.For, scope: Scope, end: int | None) -> bool:
        """Read a loop over known functions or objects, such as callbacks, for each; return whether it is one."""
        match loop.target, callbacks(value_of(loop.iter, scope)):
            case ast.Name(name), [_, *_] as held if name in scope.once:
                self._calls(loop.iter, scope, end)
                for one in held:
                    scope.known[name] = one
                    self._body(loop.body, scope, end)
                return True
        return False

    def _ask(self, part: ast.AST, into: set[str], but: Collection[int] = ()) -> None:
        """Record the attributes and texts in a statement or expression, except the nodes `but`."""
        for node in () if self._only_gradients else ast.walk(part):
            match node:
                case ast.Attribute(attr=str(name)) | ast.Constant(str(name)) if id(node) not in but:
                    into.add(name)

    def note(self, name: str, end: int | None) -> None:
        """Record a call that the loop no longer makes from iteration `end` on; None if the call has no end."""
        if self._only_gradients and name != READS_GRADIENT:
            return
        before = self.ends.get(name, 0)
        self.ends[name] = None if end is None or before is None else max(before, end)

    def _follow(self, name: str, call: ast.Call, scope: Scope, end: int | None) -> None:
        call, function, syntax = self._called(call, scope)
        if syntax is None:
            return
        outer = self._only_gradients
        self._only_gradients = outer or name in self._stops
        if syntax.name != name:  # the loop has a name of its own for it: `prune = gaussians.prune_points`
            self.note(syntax.name, end)
        self._only_gradients |= syntax.name in self._stops
        self.read(function, *self._arguments(call, function, syntax, scope), end)
        self._only_gradients = outer

    def _called(self, call: ast.Call, scope: Scope) -> tuple[ast.Call, Any, ast.FunctionDef | None]:
        """Return a call, the function that it calls, and its syntax; None if that is no function of the trainer."""
        found = called_function(call.func, scope.values, lambda place: value_of(place, scope), scope.code)
        call, function = without_partial(call, found, lambda own, value: named(own, value, scope))
        plain = undecorated(function)
        return call, function, None if plain is None or plain not in self.trainer else syntax_of(plain)

    def _arguments(
        self, call: ast.Call, function: Any, syntax: ast.FunctionDef, scope: Scope
    ) -> tuple[set[str], dict[str, Any]]:
        """Return the expressions that hold the number inside a called function, and known values of its arguments."""
        owner = getattr(function, "__self__", None)
        parameters = [one.arg for one in syntax.args.args][owner is not None :]
        given = [*zip(parameters, call.args, strict=False), *((one.arg, one.value) for one in call.keywords if one.arg)]
        numbers = {parameter for parameter, value in given if offset_of(value, scope) == 0}.difference(stored(syntax))
        # Attributes of the object have the same name in all of its methods.
        numbers |= {text for text in scope.numbers if text.startswith("self.") and owner is scope.values.get("self")}
        if scope.code is not None and scope.code.co_name == syntax.name:  # of the parent, which may have the loop
            numbers |= scope.numbers
        values = {parameter: value_of(value, scope) for parameter, value in given if parameter not in numbers}
        return numbers, {text: value for text, value in values.items() if value is not None}

    def _end(self, test: ast.expr, scope: Scope, holds: bool = True) -> int | None:
        """Return the first iteration from which a condition stays false (true, unless `holds`); None if unknown."""
        if is_option(test, scope):
            return None if bool(evaluated(test, scope, otherwise=holds)) is holds else 0
        match test:
            case ast.Name(name) if name in scope.meanings:
                return self._end(scope.meanings[name], without(name, scope), holds)
            case ast.UnaryOp(ast.Not(), operand):
                return self._end(operand, scope, not holds)
            case ast.BoolOp(operator, parts):
                ends = [self._end(part, scope, holds) for part in parts]
                known = [end for end in ends if end is not None]
                if isinstance(operator, ast.And) is holds:
                    return min(known, default=None)
                return max(known) if len(known) == len(ends) else None
            case ast.Compare(left, [operator], [right]) if not holds:
                negated = _NEGATED.get(type(operator))
                return None if negated is None else _end_of_one(left, negated(), right, scope)
            case ast.Compare(left, operators, others) if holds:
                sides = [left, *others]
                limits = [_end_of_one(*one, scope) for one in zip(sides, operators, others, strict=False)]
                return min((end for end in limits if end is not None), default=None)
            case ast.Call(ast.Name(name), [number, first, last, *_]) if holds and name in self._windows:
                start, end = value_of(first, scope), value_of(last, scope)
                if ast.unparse(number) not in scope.numbers or not isinstance(start, int) or not isinstance(end, int):
                    return None
                return 0 if start < 0 else end if end >= 0 else None
            case ast.Call(ast.Attribute(place, "get"), [number]) if holds:
                return _end_of_one(number, ast.In(), place, scope)
            case ast.NamedExpr(_, value):
                return self._end(value, scope, holds)
            case ast.IfExp(choice, one, other):
                chosen = ast.BoolOp(ast.And(), [choice, one])
                left = ast.BoolOp(ast.And(), [ast.UnaryOp(ast.Not(), choice), other])
                return self._end(ast.BoolOp(ast.Or(), [chosen, left]), scope, holds)
            case ast.Call():
                return self._end_of_result(test, scope, holds)
        return None

    def _end_of_result(self, call: ast.Call, scope: Scope, holds: bool) -> int | None:
        """Return the result of `_end` for a call of a trainer's function that only returns a condition."""
        call, function, syntax = self._called(call, scope)
        plain, result = undecorated(function), None if syntax is None else returned(syntax.body)
        if plain is None or syntax is None or result is None or plain.__code__ in self._open:
            return None
        numbers, values = self._arguments(call, function, syntax, scope)
        self._open.append(plain.__code__)
        end = self._end(result, self._scope(function, plain, syntax, numbers, values), holds)
        self._open.pop()
        return end


def read_loops(
    function: ast.FunctionDef,
    number: str,
    values: Mapping[str, Any],
    trainer: Iterable[Part | None],
    stops: Iterable[str],
    gated: Iterable[str],
) -> CallReader:
    """Read the loops of a function, and return what was found in them.

    Args:
        function: The function that holds the loop.
        number: Variable of the loop that holds the iteration's number.
        values: Values of the loop's names when it begins.
        trainer: Functions and classes of the trainer, if known. Its other functions are read if the loop calls them.
        stops: See `CallReader`.
        gated: See `CallReader`.
    """
    reader = CallReader(stops, gated)
    for part in trainer:
        if part is not None:
            reader.trainer.add(part)
    reader.read_loops(function, Scope(frozenset({number}), values))
    return reader


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


def _end_of_one(left: ast.expr, operator: ast.cmpop, right: ast.expr, scope: Scope) -> int | None:
    if offset_of(left, scope) is None and type(operator) in _MIRRORED:  # X > iteration
        left, right = right, left
        operator = _MIRRORED[type(operator)]()
    offset, limit = offset_of(left, scope), value_of(right, scope)
    if offset is None:
        return None
    if isinstance(operator, ast.In) and isinstance(limit, Collection) and not isinstance(limit, (str, bytes)):
        return max((int(number) - offset for number in limit), default=0) + 1
    if isinstance(limit, bool) or not isinstance(limit, (int, float)) or not math.isfinite(limit):
        return None
    if isinstance(operator, ast.Lt):
        return math.ceil(limit) - offset
    if isinstance(operator, (ast.LtE, ast.Eq)):
        return math.floor(limit) - offset + 1
    return None
