"""Iterations that must run, read from the loop itself: its conditions on the iteration's number.

A training loop saves, evaluates, prunes and reports by number: `if iteration % 1000 == 0`, `if iteration in
saving_iterations`. Such conditions are read from the source of the function and evaluated ahead of time. Nothing of
the source is changed.
"""

from __future__ import annotations

import ast
import copy
import inspect
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from numbers import Integral
from types import CodeType
from typing import Any, NamedTuple

from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pace.display import Moves, moves, only_shows
from skipgs_plug.core.pace.settled import Settled

SAFE = frozenset({"abs", "bool", "int", "len", "max", "min", "round"})
# Methods by which lists, sets and queues change: their object differs in the next iteration.
CHANGES = frozenset({"add", "append", "appendleft", "clear", "discard", "extend", "insert", "pop", "popleft", "remove"})
_POINT = (ast.Eq, ast.NotEq, ast.In, ast.NotIn, ast.Is, ast.IsNot)
_PLACE = (ast.Name, ast.Attribute, ast.Subscript)


class _Leaf(NamedTuple):
    """A part of a condition that is no `and`, `or` or `not`.

    Attributes:
        code: Evaluated, with the number where it stands in the part; None if the value is not known.
        unforeseeable: it depends on the number and on what only happens in the loop.
    """

    code: CodeType | None
    unforeseeable: bool


class Condition:
    """One condition of the loop on its number, with those it is nested in.

    Attributes:
        text: as it stands in the source.
        line: where.
        shown: The `if` with it, or around it, that only moves a progress bar; None if there is none.
    """

    def __init__(self, test: ast.expr, path: list[ast.expr], loop: LoopCode) -> None:
        self.text, self.line = ast.unparse(test), loop.first_line + test.lineno - 1
        self._loop = loop
        self._test = test
        self.shown = loop.shown_at(test)
        self._path = path
        self._leaves: dict[int, _Leaf] = {}
        self._ordered: dict[int, list[ast.expr]] = {}

    def numbers(self, numbers: range, names: Mapping[str, Any]) -> set[int]:
        """Return the numbers for which the condition takes the rarer of its two branches, whatever else it depends on.

        Raises:
            SkipGSError: It depends on something that changes in the loop.
        """
        found: set[int] = set()
        for holds, others in self._branches(numbers, names):
            found |= holds if len(holds) <= len(others) else others
        return found

    def holds(self, numbers: range, names: Mapping[str, Any]) -> set[int] | None:
        """Return the numbers for which the condition holds; None if that depends on something else, too."""
        try:
            (first, _), (second, _) = self._branches(numbers, names)
        except SkipGSError:
            return None
        return first if first == second else None

    def _branches(self, numbers: range, names: Mapping[str, Any]) -> Iterator[tuple[set[int], set[int]]]:
        """Numbers of both branches, with each assumption about parts that say nothing of the number."""
        values = dict(names)  # once: it holds every global name of the loop's module
        for assumed in (True, False):
            holds: set[int] = set()
            others: set[int] = set()
            for number in numbers:
                values[self._loop.target] = number
                if all(self._value(outer, values, True) for outer in self._path):
                    (holds if self._value(self._test, values, assumed) else others).add(number)
            yield holds, others

    def _value(self, node: ast.expr, values: dict[str, Any], assumed: bool) -> bool:
        if isinstance(node, ast.BoolOp):
            combine = all if isinstance(node.op, ast.And) else any
            return combine(self._value(part, values, assumed) for part in self._parts(node))
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return not self._value(node.operand, values, not assumed)
        leaf = self._leaf(node)
        if leaf.unforeseeable and self._is_tested(node):
            raise SkipGSError(
                f"Line {self.line} of {self._loop.file} has a condition on the iteration's number that cannot be "
                f"evaluated ahead ({self.text}), so an iteration that it needs could be left out; use the gate "
                "without a share, or name the iterations that must run (--always, always=)."
            )
        if leaf.code is None:
            return assumed
        try:
            return bool(eval(leaf.code, values))
        except Exception:  # a name that is not bound yet, a number of another kind
            return assumed

    def is_of(self, statement: ast.If) -> bool:
        """Whether it is the condition of this `if`."""
        return _place(self._test) == _place(statement.test)

    def _parts(self, node: ast.BoolOp) -> list[ast.expr]:
        """The parts of an `and` or `or`, those last that cannot be foreseen: others may decide without them."""
        found = self._ordered.get(id(node))
        if found is None:
            found = sorted(node.values, key=lambda part: any(self._leaf(leaf).unforeseeable for leaf in _leaves(part)))
            self._ordered[id(node)] = found
        return found

    def _is_tested(self, node: ast.expr) -> bool:
        """Whether a part is one of the condition itself, not of those around it, and picks single numbers."""
        return _is_point(node) and any(leaf is node for leaf in _leaves(self._test))

    def _leaf(self, node: ast.expr) -> _Leaf:
        found = self._leaves.get(id(node))
        if found is None:
            found = self._leaves[id(node)] = self._loop.leaf(node)
        return found


class LoopCode:
    """One `for` statement of a function, whose target is the iteration's number.

    Args:
        statement: The loop.
        around: What it stands in: the function, or the module.
        code: Of that.
        names: What it has names for before the loop, and names that the loop gives a value which is known.
        known: Which names these are.
        pure: Functions that only look at numbers.
    """

    def __init__(
        self,
        statement: ast.For,
        around: ast.AST,
        code: CodeType,
        names: Mapping[str, Any],
        known: Iterable[str],
        pure: frozenset[str],
    ) -> None:
        assert isinstance(statement.target, ast.Name)
        self.target = statement.target.id
        self.file, self.first_line = code.co_filename, _first_line(code)
        self._pure = pure | SAFE
        parts = [node for one in statement.body for node in ast.walk(one)]
        own = {id(name) for node in parts if isinstance(node, ast.comprehension) for name in ast.walk(node.target)}
        stored = [
            ast.unparse(node)
            for node in parts
            if isinstance(node, _PLACE) and not isinstance(node.ctx, ast.Load) and id(node) not in own
        ]
        called = [node.func for node in parts if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]
        self._counters = {text for text in _counted(statement.body) if stored.count(text) == 1}
        changed = {*stored, *(ast.unparse(method.value) for method in called if method.attr in CHANGES)}
        self._changing = changed.difference(known)
        self._settled = Settled(code, around, names, self._changing | {self.target}, self._pure)
        self._names = names
        outermost: list[ast.If] = []
        for node in (part for part in parts if isinstance(part, ast.If)):  # outer ones come first
            if not any(_is_inside(node, outer) for outer in outermost) and only_shows(node, names, around):
                outermost.append(node)
        self._shown = outermost
        self.body = self._spelled_out(statement.body, stored)

    def _spelled_out(self, body: list[ast.stmt], stored: list[str]) -> list[ast.stmt]:
        """Replace names that stand for something of the number, `place = step % len(views)`, or for an option."""
        for index in range(len(_assigned(body))):
            place, value = _assigned(body)[index]  # what came before it is spelled out in it
            text = ast.unparse(place)
            if not isinstance(place, (ast.Name, ast.Attribute)) or stored.count(text) != 1:
                continue
            if value in self._settled or (self.mentions(value) and not self.leaf(value).unforeseeable):
                body = [_Inline(text, value, place.lineno).visit(copy.deepcopy(one)) for one in body]
        return body

    def shown_at(self, test: ast.expr) -> ast.If | None:
        """The outermost `if` that only moves a progress bar, and has this condition as its own or inside it."""
        return next((one for one in self._shown if _is_inside(test, one)), None)

    def milestones(self, numbers: range) -> dict[str, set[int]]:
        """Return the iterations that must run, by the condition that names them.

        Args:
            numbers: Iterations that may be left out.

        Returns:
            By "line N: condition", or "line N: list" of iterations that is handed to a function with the number. Of a
            condition that holds for none of the numbers there are none. One that only moves a bar is not among them:
            see `bar_moves`.

        Warns:
            RuntimeWarning: A condition is on what the loop counts by itself, and comes less often for each number left
                out.

        Raises:
            SkipGSError: A condition cannot be evaluated ahead.
        """
        for leaf in self.counted_by_itself():
            caution(
                f"Line {self.first_line + leaf.lineno - 1} of {self.file} ({ast.unparse(leaf)}) counts the iterations "
                f"that run; where others are left out it happens less often. Decide by {self.target} if that matters."
            )
        found: dict[str, set[int]] = {}
        for condition in self.conditions():
            if condition.shown is not None:
                continue
            hits = condition.numbers(numbers, self._names)
            found.setdefault(f"line {condition.line}: {condition.text}", set()).update(hits)
        for node in self.lists():
            try:
                value = eval(compile(ast.Expression(node), self.file, "eval"), dict(self._names))
            except Exception:
                continue
            if _is_list(value):
                hits = {int(entry) for entry in value if entry in numbers}
                if hits:
                    found[f"line {self.first_line + node.lineno - 1}: {ast.unparse(node)}"] = hits
        return found

    def bar_moves(self, numbers: range) -> list[Moves]:
        """Return how the loop moves bars on by hand, in iterations that need not run for it."""
        found = [Moves(bar, by, numbers) for bar, by in moves(list(_always(self.body)), self._names)]
        for condition in self.conditions():
            if condition.shown is not None and condition.is_of(condition.shown):
                hits = condition.holds(numbers, self._names)
                if hits is not None:
                    found += [Moves(bar, by, frozenset(hits)) for bar, by in moves(condition.shown.body, self._names)]
        return found

    def leaf(self, node: ast.expr) -> _Leaf:
        if not self.mentions(node):
            return _Leaf(self._compiled(node) if node in self._settled else None, False)
        inner = {
            name.id
            for part in ast.walk(node)
            if isinstance(part, ast.comprehension)
            for name in ast.walk(part.target)
            if isinstance(name, ast.Name)
        }
        places = {ast.unparse(part) for part in ast.walk(node) if isinstance(part, _PLACE)} - inner
        calls = [part for part in ast.walk(node) if isinstance(part, ast.Call)]
        impure = any(not isinstance(call.func, ast.Name) or call.func.id not in self._pure for call in calls)
        if impure or places & self._changing:
            return _Leaf(None, True)
        return _Leaf(self._compiled(node), False)

    def _compiled(self, node: ast.expr) -> CodeType:
        return compile(ast.Expression(node), self.file, "eval")

    def mentions(self, node: ast.AST) -> bool:
        """Whether the number stands in this part of the source."""
        return any(isinstance(part, ast.Name) and part.id == self.target for part in ast.walk(node))

    def conditions(self) -> Iterator[Condition]:
        """All conditions that hold for single numbers, not for a stretch of them."""
        for test, path in _tests(self.body, []):
            if self.mentions(test) and any(_is_point(leaf) and self.mentions(leaf) for leaf in _leaves(test)):
                yield Condition(test, path, self)

    def counted_by_itself(self) -> Iterator[ast.expr]:
        """All conditions on what the loop counts up by itself, which stands still where an iteration is left out."""
        for test, path in _tests(self.body, []):
            if any(self._is_off(outer) for outer in path):
                continue
            for leaf in _leaves(test):
                read = {ast.unparse(part) for part in ast.walk(leaf) if isinstance(part, _PLACE)}
                picks = isinstance(leaf, (ast.Compare, ast.BinOp)) and _is_point(leaf)
                if picks and read & self._counters and not self.mentions(leaf):
                    yield leaf

    def _is_off(self, test: ast.expr) -> bool:
        """Whether an option that is off keeps this condition from ever holding."""
        parts = test.values if isinstance(test, ast.BoolOp) and isinstance(test.op, ast.And) else [test]
        return any(part in self._settled and not eval(self._compiled(part), dict(self._names)) for part in parts)

    def lists(self) -> Iterator[ast.expr]:
        """What is handed on together with the number, where it may be a list of iterations."""
        for statement in self.body:
            for call in ast.walk(statement):
                if not isinstance(call, ast.Call):
                    continue
                given = [*call.args, *(keyword.value for keyword in call.keywords)]
                if any(isinstance(value, ast.Name) and value.id == self.target for value in given):
                    yield from (value for value in given if isinstance(value, (ast.Name, ast.Attribute)))


def _place(node: ast.stmt | ast.expr) -> tuple[int, int]:
    """Where it begins. What is put in the place of a name stands where the name stood."""
    return node.lineno, node.col_offset


def _is_inside(node: ast.stmt | ast.expr, outer: ast.stmt) -> bool:
    end = outer.end_lineno or outer.lineno, outer.end_col_offset or outer.col_offset
    return _place(outer) <= _place(node) < end


def _always(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """These statements, and in place of a `with` block those inside it."""
    for node in body:
        if isinstance(node, (ast.With, ast.AsyncWith)):
            yield from _always(node.body)
        else:
            yield node


def _assigned(body: list[ast.stmt]) -> list[tuple[ast.expr, ast.expr]]:
    """Places that these statements give a value to in every iteration, each with the value, in their order."""
    found: list[tuple[ast.expr, ast.expr]] = []
    for node in _always(body):
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            found.append((node.target, node.value))
        elif isinstance(node, ast.Assign) and len(node.targets) == 1:
            place, value = node.targets[0], node.value
            if isinstance(place, ast.Tuple) and isinstance(value, ast.Tuple) and len(place.elts) == len(value.elts):
                found += zip(place.elts, value.elts, strict=True)
            else:
                found.append((place, value))
    return found


def _counted(body: list[ast.stmt]) -> Iterator[str]:
    """Places to which these statements add a constant in every iteration."""
    for node in _always(body):
        if isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add) and isinstance(node.value, ast.Constant):
            yield ast.unparse(node.target)


class _Inline(ast.NodeTransformer):
    """Puts an expression where a name or an attribute is read below a line; above, it is of the iteration before."""

    def __init__(self, name: str, value: ast.expr, line: int) -> None:
        self._name, self._value, self._line = name, value, line

    def visit_Name(self, node: ast.Name | ast.Attribute) -> ast.AST:
        if isinstance(node.ctx, ast.Load) and node.lineno > self._line and ast.unparse(node) == self._name:
            return ast.copy_location(copy.deepcopy(self._value), node)
        return self.generic_visit(node)

    visit_Attribute = visit_Name


def read_loop(
    code: CodeType,
    line: int,
    names: Mapping[str, Any],
    pure: Iterable[str] = (),
    known: Mapping[str, Any] | None = None,
) -> LoopCode:
    """Return the loop that asks for its numbers.

    Args:
        code: Of the function that holds the loop.
        line: Where the function stands when the loop asks for a number: in the first lines of its `for`.
        names: What the function had names for before its loop began.
        pure: Functions that only look at numbers, and may stand in conditions.
        known: Values of names that the loop assigns, where they are known before it.

    Raises:
        SkipGSError: The source cannot be read, or has no loop.
    """
    known = known or {}
    function = code.co_flags & inspect.CO_NEWLOCALS
    try:
        # Of a module, getsource gives what stands before its first function alone.
        source = inspect.getsource(code) if function else "".join(inspect.findsource(code)[0])
        tree = ast.parse(textwrap.dedent(source))
    except (OSError, TypeError, SyntaxError) as error:
        raise SkipGSError(
            f"The source of {code.co_name}() in {code.co_filename} cannot be read ({error}), so it cannot be known "
            "which iterations must run; gate without share and refine_share, or name them (--always, always=)."
        ) from error
    first = _first_line(code)
    for node in ast.walk(tree):
        # Loops inside and around it do not stand there.
        if (
            isinstance(node, ast.For)
            and isinstance(node.target, ast.Name)
            and node.lineno <= line - first + 1 <= (node.iter.end_lineno or node.lineno)
        ):
            return LoopCode(node, tree, code, {**names, **known}, known, frozenset(pure))
    raise SkipGSError(
        f"Line {line} of {code.co_filename} is not in a loop over one number; "
        "write the loop as: for step in gate.iterations(range(...))."
    )


def _is_list(value: Any) -> bool:
    """Whether this can be a list of iterations; a range without gaps is the whole run."""
    if isinstance(value, range):
        return value.step != 1
    return isinstance(value, (list, tuple, set, frozenset)) and all(isinstance(entry, Integral) for entry in value)


def _first_line(code: CodeType) -> int:
    """Line of the file that is the first one of this code's source."""
    return code.co_firstlineno if code.co_flags & inspect.CO_NEWLOCALS else 1


def _tests(body: list[ast.stmt], path: list[ast.expr]) -> Iterator[tuple[ast.expr, list[ast.expr]]]:
    """All conditions in these statements, each with those that must hold for it to be looked at."""
    for statement in body:
        if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            continue
        if isinstance(statement, (ast.If, ast.While)):
            yield statement.test, path
            yield from _tests(statement.body, [*path, statement.test])
            otherwise = ast.copy_location(ast.UnaryOp(ast.Not(), statement.test), statement.test)
            yield from _tests(statement.orelse, [*path, otherwise])
            continue
        if isinstance(statement, ast.Match):
            for part in (part for case in statement.cases for part in ast.walk(case.pattern)):
                if isinstance(part, ast.MatchValue):
                    equal = ast.Compare(statement.subject, [ast.Eq()], [part.value])
                    yield ast.copy_location(equal, part.value), path
        inner = [part for part in ast.iter_child_nodes(statement) if isinstance(part, ast.stmt)]
        for part in (*getattr(statement, "handlers", ()), *getattr(statement, "cases", ())):
            inner += part.body
        yield from _tests(inner, path)
        for part in ast.iter_child_nodes(statement):
            if isinstance(part, ast.expr):
                yield from ((test, path) for test in _values(part))


def _values(node: ast.AST) -> Iterator[ast.expr]:
    """Conditions inside an expression: `flag = iteration % 10 == 0`, `a if iteration in b else c`."""
    if isinstance(node, (ast.BoolOp, ast.Compare)) or (isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)):
        yield node
        return
    if isinstance(node, ast.IfExp):
        yield node.test
        children: list[ast.AST] = [node.body, node.orelse]
    else:
        children = list(ast.iter_child_nodes(node))
    for child in children:
        yield from _values(child)


def _leaves(node: ast.expr) -> Iterator[ast.expr]:
    if isinstance(node, ast.BoolOp):
        for part in node.values:
            yield from _leaves(part)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield from _leaves(node.operand)
    else:
        yield node


def _is_point(leaf: ast.expr) -> bool:
    """Whether a part of a condition picks single numbers: equality, membership, a remainder, or a function's word."""
    if isinstance(leaf, ast.Compare):
        return any(isinstance(operator, _POINT) for operator in leaf.ops) or any(
            isinstance(part, ast.Mod) for part in ast.walk(leaf)
        )
    # The training backward of a loop of one's own, which gets the number too, is no milestone.
    return not (isinstance(leaf, ast.Call) and isinstance(leaf.func, ast.Attribute) and leaf.func.attr == "backward")
