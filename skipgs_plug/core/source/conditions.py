"""Conditions in the source of a loop, each with the conditions under which the loop reaches it."""

from __future__ import annotations

import ast
import copy
from collections.abc import Container, Iterator, Mapping, Sequence
from typing import NamedTuple

from skipgs_plug.core.source.inlining import InlinedFunction

# Comparisons that hold for single numbers. The others hold for a range of numbers.
_PICKS = (ast.Eq, ast.NotEq, ast.In, ast.NotIn, ast.Is, ast.IsNot)
_ENDS = (ast.Return, ast.Continue, ast.Break, ast.Raise)  # statements that end an iteration or a function
Guards = tuple[ast.expr, ...]  # conditions that all hold where a statement is reached


class Condition(NamedTuple):
    """A condition in the source.

    Attributes:
        test: The condition.
        guards: Conditions that all hold where it is evaluated.
        function: The function that contains it, if the loop calls one; None in the loop itself.
    """

    test: ast.expr
    guards: Guards
    function: InlinedFunction | None


def conditions_in(
    body: Sequence[ast.stmt],
    functions: Mapping[int, InlinedFunction],
    guards: Guards = (),
    function: InlinedFunction | None = None,
    unread: Container[int] = (),
) -> Iterator[Condition]:
    """Yield all conditions in statements, and in the functions that they call; and all calls that are not read.

    Args:
        body: The statements.
        functions: Inlined functions by the id of the call, or of the attribute or entry that makes it.
        guards: Conditions under which the statements run.
        function: The function that the statements are of; None for the loop.
        unread: Calls that stand for conditions, because their functions are not read, by id.
    """
    for statement in body:
        if isinstance(statement, ast.ClassDef):
            continue
        for call, reached in _calls_of(statement, guards):
            if id(call) in unread:
                yield Condition(call, reached, function)
            if (inside := functions.get(id(call))) is not None:
                yield from conditions_in(inside.body, functions, reached, inside, unread)
        if isinstance(statement, (ast.If, ast.While)):
            yield Condition(statement.test, guards, function)
            # If the loop ends in the body, no other iteration comes to its conditions.
            if function is not None or not isinstance(statement.body[-1], (ast.Return, ast.Raise)):
                yield from conditions_in(statement.body, functions, (*guards, statement.test), function, unread)
            yield from conditions_in(statement.orelse, functions, (*guards, _not(statement.test)), function, unread)
        else:
            if isinstance(statement, ast.Match):
                yield from (Condition(equal, guards, function) for equal in _cases(statement))
            for block in _blocks(statement):
                yield from conditions_in(block, functions, guards, function, unread)
            for part in ast.iter_child_nodes(statement):
                if isinstance(statement, ast.Expr) and isinstance(part, ast.BoolOp):
                    yield Condition(_deciding(part), guards, function)
                elif isinstance(part, ast.expr):
                    yield from (Condition(*found, function) for found in _values(part, guards))
        ends = _ends_early([statement])
        if ends is not None:
            guards = (*guards, _not(ends))


def leaves(node: ast.expr) -> Iterator[ast.expr]:
    """Yield the parts of a condition that are no `and`, `or` or `not`."""
    if isinstance(node, ast.BoolOp):
        for part in node.values:
            yield from leaves(part)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        yield from leaves(node.operand)
    else:
        yield node


def is_point(leaf: ast.expr) -> bool:
    """Whether a part of a condition picks single numbers: by equality, membership, a remainder or a called function.

    So does the comparison of two numbers' stages, as in `step // 100 > (step - 1) // 100`.
    """
    if isinstance(leaf, ast.Compare):
        compared = zip(leaf.ops, leaf.comparators, strict=True)
        if any(isinstance(operator, _PICKS) and not _is_stretch(right) for operator, right in compared):
            return True
        stages = all(_has(one, ast.FloorDiv) for one in (leaf.left, *leaf.comparators))
        return stages or _has(leaf, ast.Mod)
    if isinstance(leaf, ast.IfExp):
        parts = [part for value in (leaf.test, leaf.body, leaf.orelse) for part in leaves(value)]
        return any(is_point(part) for part in parts if not isinstance(part, ast.Constant))
    # The training backward of a user's own loop receives the number too, but is not a milestone.
    return not (isinstance(leaf, ast.Call) and isinstance(leaf.func, ast.Attribute) and leaf.func.attr == "backward")


def _has(node: ast.expr, operator: type[ast.operator]) -> bool:
    return any(isinstance(part, operator) for part in ast.walk(node))


def _is_stretch(values: ast.expr) -> bool:
    """Whether these are all numbers between two, as in `step in range(30, 40)`, which says `30 <= step < 40`."""
    match values:
        case ast.Call(ast.Name("range"), [_] | [_, _]):
            return True
    return False


def unconditional(body: Sequence[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield these statements, and the statements inside a `with` block in place of the block."""
    for statement in body:
        if isinstance(statement, (ast.With, ast.AsyncWith)):
            yield from unconditional(statement.body)
        else:
            yield statement


def case_test(subject: ast.expr, case: ast.match_case) -> ast.expr:
    """Return a condition that holds if a case of a `match` is taken; true if its pattern has no values."""
    names = [part for part in ast.walk(case.pattern) if isinstance(part, ast.MatchAs)]
    parts: list[ast.expr] = [*_compared(case.pattern, subject)]
    if not parts or any(one.pattern is None for one in names):  # a name alone, and `_`, take every value
        parts = [ast.Constant(True)]
    elif len(parts) > 1:
        parts = [ast.BoolOp(ast.Or(), parts)]
    if case.guard is not None:
        parts.append(_guard(case.pattern, case.guard, subject))
    test = parts[0] if len(parts) == 1 else ast.BoolOp(ast.And(), parts)
    return ast.fix_missing_locations(ast.copy_location(test, case.pattern))


def is_inside(node: ast.stmt | ast.expr, outer: ast.stmt) -> bool:
    """Whether a node is part of a statement. An expression that replaces a name has the position of the name."""
    end = outer.end_lineno or outer.lineno, outer.end_col_offset or outer.col_offset
    return position(outer) <= position(node) < end


def position(node: ast.stmt | ast.expr) -> tuple[int, int]:
    """Return line and column where a node begins."""
    return node.lineno, node.col_offset


def _not(test: ast.expr) -> ast.expr:
    return ast.copy_location(ast.UnaryOp(ast.Not(), test), test)


def _blocks(statement: ast.stmt) -> Iterator[list[ast.stmt]]:
    for field in ("body", "orelse", "finalbody"):
        yield getattr(statement, field, [])
    for part in (*getattr(statement, "handlers", ()), *getattr(statement, "cases", ())):
        yield part.body


def _ends_early(body: Sequence[ast.stmt]) -> ast.expr | None:
    """Return the condition under which statements end the iteration or the function early; None if they never do."""
    ways: list[ast.expr] = []
    for statement in body:
        if isinstance(statement, _ENDS):
            ways.append(ast.copy_location(ast.Constant(True), statement))
        elif isinstance(statement, ast.If):
            for test, block in ((statement.test, statement.body), (_not(statement.test), statement.orelse)):
                if (inside := _ends_early(block)) is not None:
                    ways.append(ast.copy_location(ast.BoolOp(ast.And(), [test, inside]), test))
        elif isinstance(statement, (ast.With, ast.AsyncWith)) and (inside := _ends_early(statement.body)) is not None:
            ways.append(inside)
    return ast.copy_location(ast.BoolOp(ast.Or(), ways), ways[0]) if len(ways) > 1 else next(iter(ways), None)


def _cases(statement: ast.Match) -> Iterator[ast.expr]:
    for case in statement.cases:
        yield from _compared(case.pattern, statement.subject)
        if case.guard is not None:
            yield _guard(case.pattern, case.guard, statement.subject)


def _guard(pattern: ast.pattern, guard: ast.expr, subject: ast.expr) -> ast.expr:
    """Return the guard of a case, with the subject in place of the names that the pattern gives to it."""
    named = {one.name: part for one, part in _matched(pattern, subject) if isinstance(one, ast.MatchAs)}
    return _Captured(named).visit(copy.deepcopy(guard))


def _compared(pattern: ast.pattern, subject: ast.expr) -> Iterator[ast.expr]:
    """Yield a comparison for each value of a pattern."""
    for one, part in _matched(pattern, subject):
        if isinstance(one, ast.MatchValue):
            yield ast.copy_location(ast.Compare(part, [ast.Eq()], [one.value]), one.value)


def _matched(pattern: ast.pattern, subject: ast.expr) -> Iterator[tuple[ast.pattern, ast.expr]]:
    """Yield a pattern and those inside it, each with the part of the subject that it takes."""
    yield pattern, subject
    inner = [one for one in ast.iter_child_nodes(pattern) if isinstance(one, ast.pattern)]
    parts = [subject] * len(inner)
    match pattern, subject:
        case ast.MatchSequence(), ast.Tuple(shown) if len(shown) == len(inner):
            parts = shown
        case ast.MatchSequence(), _:
            parts = [ast.Subscript(subject, ast.Constant(index), ast.Load()) for index in range(len(inner))]
        case ast.MatchMapping(keys), _:
            parts = [ast.Subscript(subject, key, ast.Load()) for key in keys]
        case ast.MatchClass(_, places, names), _ if not places:
            parts = [ast.Attribute(subject, name, ast.Load()) for name in names]
    for one, part in zip(inner, parts, strict=True):
        yield from _matched(one, part)


class _Captured(ast.NodeTransformer):
    """Puts the subject of a `match` in place of the names that a pattern gives to it."""

    def __init__(self, named: Mapping[str | None, ast.expr]) -> None:
        self._named = named

    def visit_Name(self, node: ast.Name) -> ast.expr:
        part = self._named.get(node.id)
        return node if part is None else ast.copy_location(copy.deepcopy(part), node)


def _deciding(expression: ast.BoolOp) -> ast.expr:
    """Return the part of a statement `a and b and f()` that decides whether `f()` is called."""
    parts = expression.values[:-1]
    return parts[0] if len(parts) == 1 else ast.copy_location(ast.BoolOp(expression.op, parts), expression)


def _values(node: ast.AST, guards: Guards) -> Iterator[tuple[ast.expr, Guards]]:
    """Yield conditions inside an expression, as in `flag = iteration % 10 == 0` or `a if iteration in b else c`."""
    if isinstance(node, (ast.BoolOp, ast.Compare)) or (isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)):
        yield node, guards
    elif isinstance(node, ast.IfExp):
        yield node.test, guards
        yield from _values(node.body, (*guards, node.test))
        yield from _values(node.orelse, (*guards, _not(node.test)))
    elif isinstance(node, (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)):
        yield from ((condition, guards) for condition in _filters(node.generators))
    else:
        for child in ast.iter_child_nodes(node):
            yield from _values(child, guards)


def _filters(generators: Sequence[ast.comprehension]) -> Iterator[ast.expr]:
    """Yield the conditions of a comprehension, each as a condition on its values: `any(v == step for v in saves)`."""
    for index, last in enumerate(generators):
        for test in last.ifs:
            one = ast.GeneratorExp(test, [*generators[:index], ast.comprehension(last.target, last.iter, [], 0)])
            anywhere = ast.Call(ast.Name("any", ast.Load()), [one], [])
            yield ast.fix_missing_locations(ast.copy_location(anywhere, test))


def _calls_of(statement: ast.stmt, guards: Guards) -> Iterator[tuple[ast.expr, Guards]]:
    """Yield the calls, attributes and entries in a statement, but not in the blocks inside it; see `_calls`."""
    for part in ast.iter_child_nodes(statement):
        if not isinstance(part, (ast.stmt, ast.ExceptHandler, ast.match_case)):
            yield from _calls(part, guards)


def _calls(node: ast.AST, guards: Guards) -> Iterator[tuple[ast.expr, Guards]]:
    """Yield the calls, attributes and entries in an expression, each with the conditions under which it is reached."""
    if isinstance(node, (ast.Call, ast.Attribute, ast.Subscript)):
        yield node, guards
    if isinstance(node, ast.BoolOp):
        for part in node.values:
            yield from _calls(part, guards)
            guards = (*guards, part if isinstance(node.op, ast.And) else _not(part))
    elif isinstance(node, ast.IfExp):
        yield from _calls(node.test, guards)
        yield from _calls(node.body, (*guards, node.test))
        yield from _calls(node.orelse, (*guards, _not(node.test)))
    else:
        for child in ast.iter_child_nodes(node):
            yield from _calls(child, guards)
