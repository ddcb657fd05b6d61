"""Iterations that must run, found in the loop's conditions on the iteration's number.

A training loop saves, evaluates, prunes and reports by number: `if iteration % 1000 == 0`, `if iteration in
saving_iterations`. This module reads such conditions from the source of the function and evaluates them ahead of time.
It does not change the source.
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

SAFE = frozenset({"abs", "bool", "int", "len", "max", "min", "round"})  # built-in functions that conditions may call
# Methods that change lists, sets and queues, so that an object can differ from iteration to iteration.
CHANGES = frozenset({"add", "append", "appendleft", "clear", "discard", "extend", "insert", "pop", "popleft", "remove"})
_POINT = (ast.Eq, ast.NotEq, ast.In, ast.NotIn, ast.Is, ast.IsNot)
_ASSIGNABLE = (ast.Name, ast.Attribute, ast.Subscript)


class _Leaf(NamedTuple):
    """A part of a condition that is not an `and`, `or` or `not`.

    Attributes:
        code: Code that gives the value for a number; None if the value is not known ahead.
        unforeseeable: Whether the value depends on the number and on values that the loop computes.
    """

    code: CodeType | None
    unforeseeable: bool


class Condition:
    """One condition of the loop on its number, with the conditions around it.

    Attributes:
        text: Source of the condition.
        line: Line of the condition in the file.
        bar_if: The `if` that has this condition, or contains it, and only advances a progress bar; None without one.
    """

    def __init__(self, test: ast.expr, path: list[ast.expr], loop: LoopCode) -> None:
        self.text, self.line = ast.unparse(test), loop.first_line + test.lineno - 1
        self._loop = loop
        self._test = test
        self.bar_if = loop.bar_if_of(test)
        self._path = path
        self._leaves: dict[int, _Leaf] = {}
        self._ordered: dict[int, list[ast.expr]] = {}

    def numbers(self, numbers: range, names: Mapping[str, Any]) -> set[int]:
        """Return the numbers of the rarer of the condition's two branches, whatever else the condition depends on.

        Raises:
            SkipGSError: The condition depends on a value that the loop changes.
        """
        found: set[int] = set()
        for holds, others in self._branches(numbers, names):
            found |= holds if len(holds) <= len(others) else others
        return found

    def holds(self, numbers: range, names: Mapping[str, Any]) -> set[int] | None:
        """Return the numbers for which the condition holds; None if it also depends on other values."""
        try:
            (first, _), (second, _) = self._branches(numbers, names)
        except SkipGSError:
            return None
        return first if first == second else None

    def _branches(self, numbers: range, names: Mapping[str, Any]) -> Iterator[tuple[set[int], set[int]]]:
        """Yield the numbers of both branches, for each assumed value of the parts that do not depend on the number."""
        values = dict(names)  # copied once, because it holds every global name of the loop's module
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
        except Exception:  # a name is not bound yet, or a number has another type
            return assumed

    def is_of(self, statement: ast.If) -> bool:
        """Whether this is the condition of the `if` itself."""
        return _position(self._test) == _position(statement.test)

    def _parts(self, node: ast.BoolOp) -> list[ast.expr]:
        """Return the parts of an `and` or `or`, unforeseeable parts last, because other parts may decide alone."""
        found = self._ordered.get(id(node))
        if found is None:
            found = sorted(node.values, key=lambda part: any(self._leaf(leaf).unforeseeable for leaf in _leaves(part)))
            self._ordered[id(node)] = found
        return found

    def _is_tested(self, node: ast.expr) -> bool:
        """Whether a part belongs to the condition itself, not to a condition around it, and picks single numbers."""
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
        around: Syntax tree of the function or module that contains the loop.
        code: Code of that function or module.
        names: Names and values before the loop, and the values in `known`.
        known: Names that the loop assigns and whose values are known before the loop.
        pure: Names of functions that only read numbers.
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
            if isinstance(node, _ASSIGNABLE) and not isinstance(node.ctx, ast.Load) and id(node) not in own
        ]
        called = [node.func for node in parts if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]
        self._counters = {text for text in _counted(statement.body) if stored.count(text) == 1}
        changed = {*stored, *(ast.unparse(method.value) for method in called if method.attr in CHANGES)}
        self._changing = changed.difference(known)
        self._settled = Settled(code, around, names, self._changing | {self.target}, self._pure)
        self._names = names
        outermost: list[ast.If] = []
        for node in (part for part in parts if isinstance(part, ast.If)):  # outer statements come first
            if not any(_is_inside(node, outer) for outer in outermost) and only_shows(node, names, around):
                outermost.append(node)
        self._bar_ifs = outermost
        self.body = self._spelled_out(statement.body, stored)

    def _spelled_out(self, body: list[ast.stmt], stored: list[str]) -> list[ast.stmt]:
        """Replace names by the expression that they stand for, if it is of the number or of options.

        An example is `index = step % len(views)`.
        """
        for index in range(len(_assigned(body))):
            target, value = _assigned(body)[index]  # earlier names are replaced in the value already
            text = ast.unparse(target)
            if not isinstance(target, (ast.Name, ast.Attribute)) or stored.count(text) != 1:
                continue
            if value in self._settled or (self.mentions(value) and not self.leaf(value).unforeseeable):
                body = [_Inline(text, value, target.lineno).visit(copy.deepcopy(one)) for one in body]
        return body

    def bar_if_of(self, test: ast.expr) -> ast.If | None:
        """Return the outermost `if` that only advances a progress bar and has or contains this condition."""
        return next((one for one in self._bar_ifs if _is_inside(test, one)), None)

    def milestones(self, numbers: range) -> dict[str, set[int]]:
        """Return the iterations that must run, by the condition that names them.

        Args:
            numbers: Iterations that may be left out.

        Returns:
            Sets of iterations by "line N: condition", or by "line N: list" for a list of iterations that the loop
            passes to a function together with the number. The set of a condition that holds for no number is empty.
            Conditions that only advance a progress bar are not included; see `bar_moves`.

        Warns:
            RuntimeWarning: A condition depends on a counter of the loop's own, so it holds less often if iterations are
                left out.

        Raises:
            SkipGSError: A condition cannot be evaluated ahead.
        """
        for leaf in self.counted_by_itself():
            caution(
                f"Line {self.first_line + leaf.lineno - 1} of {self.file} ({ast.unparse(leaf)}) counts the iterations "
                f"that run, so it holds less often if others are left out. Decide by {self.target} if that matters."
            )
        found: dict[str, set[int]] = {}
        for condition in self.conditions():
            if condition.bar_if is not None:
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
        """Return how the loop advances progress bars by hand, in iterations that need not run for them."""
        found = [Moves(bar, by, numbers) for bar, by in moves(list(_always(self.body)), self._names)]
        for condition in self.conditions():
            if condition.bar_if is not None and condition.is_of(condition.bar_if):
                hits = condition.holds(numbers, self._names)
                if hits is not None:
                    found += [Moves(bar, by, frozenset(hits)) for bar, by in moves(condition.bar_if.body, self._names)]
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
        read = {ast.unparse(part) for part in ast.walk(node) if isinstance(part, _ASSIGNABLE)} - inner
        calls = [part for part in ast.walk(node) if isinstance(part, ast.Call)]
        impure = any(not isinstance(call.func, ast.Name) or call.func.id not in self._pure for call in calls)
        if impure or read & self._changing:
            return _Leaf(None, True)
        return _Leaf(self._compiled(node), False)

    def _compiled(self, node: ast.expr) -> CodeType:
        return compile(ast.Expression(node), self.file, "eval")

    def mentions(self, node: ast.AST) -> bool:
        """Whether the number occurs in this part of the source."""
        return any(isinstance(part, ast.Name) and part.id == self.target for part in ast.walk(node))

    def conditions(self) -> Iterator[Condition]:
        """Yield all conditions that hold for single numbers, not for a range of numbers."""
        for test, path in _tests(self.body, []):
            if self.mentions(test) and any(_is_point(leaf) and self.mentions(leaf) for leaf in _leaves(test)):
                yield Condition(test, path, self)

    def counted_by_itself(self) -> Iterator[ast.expr]:
        """Yield all conditions on a counter of the loop's own, which does not count left-out iterations."""
        for test, path in _tests(self.body, []):
            if any(self._is_off(outer) for outer in path):
                continue
            for leaf in _leaves(test):
                read = {ast.unparse(part) for part in ast.walk(leaf) if isinstance(part, _ASSIGNABLE)}
                picks = isinstance(leaf, (ast.Compare, ast.BinOp)) and _is_point(leaf)
                if picks and read & self._counters and not self.mentions(leaf):
                    yield leaf

    def _is_off(self, test: ast.expr) -> bool:
        """Whether the condition never holds because an option is off."""
        parts = test.values if isinstance(test, ast.BoolOp) and isinstance(test.op, ast.And) else [test]
        return any(part in self._settled and not eval(self._compiled(part), dict(self._names)) for part in parts)

    def lists(self) -> Iterator[ast.expr]:
        """Yield names that are passed to a function together with the number, and may be lists of iterations."""
        for statement in self.body:
            for call in ast.walk(statement):
                if not isinstance(call, ast.Call):
                    continue
                given = [*call.args, *(keyword.value for keyword in call.keywords)]
                if any(isinstance(value, ast.Name) and value.id == self.target for value in given):
                    yield from (value for value in given if isinstance(value, (ast.Name, ast.Attribute)))


def _position(node: ast.stmt | ast.expr) -> tuple[int, int]:
    """Return line and column where a node begins. An expression that replaces a name has the position of the name."""
    return node.lineno, node.col_offset


def _is_inside(node: ast.stmt | ast.expr, outer: ast.stmt) -> bool:
    end = outer.end_lineno or outer.lineno, outer.end_col_offset or outer.col_offset
    return _position(outer) <= _position(node) < end


def _always(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield these statements, and the statements inside a `with` block in place of the block."""
    for node in body:
        if isinstance(node, (ast.With, ast.AsyncWith)):
            yield from _always(node.body)
        else:
            yield node


def _assigned(body: list[ast.stmt]) -> list[tuple[ast.expr, ast.expr]]:
    """Return the names and attributes that these statements assign in every iteration, with their values, in order."""
    found: list[tuple[ast.expr, ast.expr]] = []
    for node in _always(body):
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            found.append((node.target, node.value))
        elif isinstance(node, ast.Assign) and len(node.targets) == 1:
            target, value = node.targets[0], node.value
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
                found += zip(target.elts, value.elts, strict=True)
            else:
                found.append((target, value))
    return found


def _counted(body: list[ast.stmt]) -> Iterator[str]:
    """Yield the names and attributes to which these statements add a constant in every iteration."""
    for node in _always(body):
        if isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add) and isinstance(node.value, ast.Constant):
            yield ast.unparse(node.target)


class _Inline(ast.NodeTransformer):
    """Replaces a name or attribute by an expression after a line; before it, the value is the previous iteration's."""

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
    first = _first_line(code)
    for node in ast.walk(tree):
        # The head of a loop inside or around it lies on other lines.
        if (
            isinstance(node, ast.For)
            and isinstance(node.target, ast.Name)
            and node.lineno <= line - first + 1 <= (node.iter.end_lineno or node.lineno)
        ):
            return LoopCode(node, tree, code, {**names, **known}, known, frozenset(pure))
    found = f"Line {line} of {code.co_filename} is not in a loop over one number"
    raise SkipGSError(
        f"{found}; write the loop as: for step in gate.iterations(range(...)).",
        in_script=f"{found}; name the iterations that must run (--always).",
    )


def _is_list(value: Any) -> bool:
    """Whether this can be a list of iterations. A range without gaps is the whole run."""
    if isinstance(value, range):
        return value.step != 1
    return isinstance(value, (list, tuple, set, frozenset)) and all(isinstance(entry, Integral) for entry in value)


def _first_line(code: CodeType) -> int:
    """Return the line of the file where the source of this code begins."""
    return code.co_firstlineno if code.co_flags & inspect.CO_NEWLOCALS else 1


def _tests(body: list[ast.stmt], path: list[ast.expr]) -> Iterator[tuple[ast.expr, list[ast.expr]]]:
    """Yield all conditions in these statements, each with the conditions under which it is evaluated."""
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
    """Yield conditions inside an expression, as in `flag = iteration % 10 == 0` or `a if iteration in b else c`."""
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
    """Whether a part picks single numbers, by equality, membership, a remainder or the result of a function."""
    if isinstance(leaf, ast.Compare):
        return any(isinstance(operator, _POINT) for operator in leaf.ops) or any(
            isinstance(part, ast.Mod) for part in ast.walk(leaf)
        )
    # The training backward of a user's own loop receives the number too, but is not a milestone.
    return not (isinstance(leaf, ast.Call) and isinstance(leaf.func, ast.Attribute) and leaf.func.attr == "backward")
