"""Where a loop's number gets to by ways that are not followed, and the conditions that may depend on it there.

The number is followed through names, attributes, entries and functions, so that conditions on it can be evaluated. A
value of a context manager, of a queue or of a function that does more than return an expression is not followed. This
module tells roughly which places such values reach, so that conditions on them are at least named.
"""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterable, Iterator, Sequence

from skipgs_plug.core.source.assignments import assignments_in
from skipgs_plug.core.source.bindings import assigned_values, held_in
from skipgs_plug.core.source.names import PLACES
from skipgs_plug.core.source.run_options import text_of

# Methods of lists, queues, tables and tensors that keep an argument.
_KEEPS = frozenset({"add", "append", "appendleft", "copy_", "extend", "extendleft", "fill_", "insert", "put", "update"})
_LOCAL = frozenset({"locals", "vars"})  # functions that return all local variables
_NUMBERED = frozenset({"enumerate", "range"})  # what they count begins anew in each iteration
# Functions that return an argument, or a value that is computed from it.
_PASSES = frozenset({"abs", "dict", "divmod", "float", "int", "iter", "list", "max", "min", "next", "reversed"})
_PASSES |= frozenset({"round", "set", "sorted", "str", "sum", "tuple", "zip"})
# Largest number of times that statements are gone through. With `node = node.next`, the places have no end.
_ROUNDS = 5


def reached_by(nodes: Sequence[ast.AST], places: Collection[str], returning: Collection[int]) -> set[str]:
    """Return the places that may hold the number, or a value that depends on it, after these statements.

    Args:
        nodes: The statements, and all nodes inside them.
        places: Names, attributes and entries that hold it before, as source text.
        returning: Calls of functions that return it, by id in the syntax tree.
    """
    found = set(places)
    for _ in range(_ROUNDS):
        before = len(found)
        for node in nodes:
            for target, value in _handed_on(node):
                held = held_in(text_of(target), value, lambda call: None)
                if text_of(target) not in held:  # a new dictionary
                    found |= {text for text, one in held.items() if carries(one, found, returning)}
                elif carries(value, found, returning):
                    found |= {text_of(one) for one in _places(target)}
                elif isinstance(target, PLACES) and isinstance(value, PLACES):
                    found |= _shared(text_of(target), text_of(value), found)
        if before == len(found):
            break
    return found


def carries(value: ast.AST | None, places: Collection[str], returning: Collection[int] = ()) -> bool:
    """Whether the value of an expression may be that of one of these places, or hold it, or be computed from it.

    Functions that are not read, as those that render an image, are taken to return something else.

    Args:
        value: The expression.
        places: Names, attributes and entries, as source text.
        returning: Calls of functions that return such a value, by id in the syntax tree.
    """

    def any_of(parts: Iterable[ast.AST | None]) -> bool:
        return any(carries(part, places, returning) for part in parts)

    match value:
        case ast.Name(name):
            return name in places
        case ast.Subscript(held, key) if not isinstance(key, ast.Constant):
            return any_of([held]) or _has_entry(held, places)
        case ast.Attribute(held) | ast.Subscript(held):
            return text_of(value) in places or any_of([held])
        case ast.Call(function, values, keywords):
            if id(value) in returning:
                return True
            match function:
                case ast.Name(name):
                    given = [*values, *(keyword.value for keyword in keywords)]
                    return (name in _PASSES and any_of(given)) or (name in _LOCAL and not given)
                case ast.Attribute(_, "enter_context") | ast.Attribute(ast.Call(), "__enter__"):
                    made = values[0] if function.attr == "enter_context" and values else function.value
                    return any_of([made, *made.args] if isinstance(made, ast.Call) else [made])
                case ast.Attribute(held):  # a method, as in `steps.popleft()`
                    return any_of([held]) or _has_entry(held, places)
            return False
        case ast.IfExp(_, holds, fails):
            return any_of([holds, fails])
        case ast.ListComp(element, _) | ast.SetComp(element, _) | ast.GeneratorExp(element, _):
            return any_of([element])
        case ast.DictComp(_, element):
            return any_of([element])
        case ast.Lambda() | ast.Compare() | ast.JoinedStr():  # a comparison is a condition itself
            return False
        case ast.expr():
            return any_of(ast.iter_child_nodes(value))
    return False


def remainders(test: ast.expr) -> Iterator[ast.expr]:
    """Yield the numbers whose remainders, or whose bits, are parts of a condition."""
    for part in ast.walk(test):
        match part:
            case ast.BinOp(ast.Constant(str()) | ast.JoinedStr(), ast.Mod()):
                continue  # a text with values
            case ast.BinOp(number, ast.Mod() | ast.BitAnd()):
                yield number


def compared(test: ast.expr) -> Iterator[ast.expr]:
    """Yield the places and calculations that a condition compares with single numbers."""
    for part in ast.walk(test):
        if isinstance(part, ast.Compare):
            values = [part.left, *part.comparators]
            picks = all(isinstance(operator, (ast.Eq, ast.NotEq, ast.In, ast.NotIn)) for operator in part.ops)
            if picks and not any(isinstance(one, ast.Constant) and not _is_number(one.value) for one in values):
                yield from (one for one in values if not isinstance(one, ast.Constant))


def is_kept_in(value: ast.expr, places: Collection[str]) -> bool:
    """Whether an expression is one of these places, an entry of one, or computed from such places alone."""
    match value:
        case ast.BinOp(left, _, right):
            return is_kept_in(left, places) or is_kept_in(right, places)
        case ast.Call(ast.Attribute(held, "item"), []) | ast.Call(ast.Name("int" | "max" | "min" | "round"), [held]):
            return is_kept_in(held, places)
        case ast.Name() | ast.Attribute():
            return text_of(value) in places
        case ast.Subscript(held):
            return text_of(value) in places or is_kept_in(held, places)
    return False


def inner_values(body: Iterable[ast.stmt]) -> Iterator[str]:
    """Yield the names that change inside a single iteration: those of loops, and parameters."""
    for node in (part for statement in body for part in ast.walk(statement)):
        if isinstance(node, (ast.For, ast.comprehension)):
            yield from (part.id for part in ast.walk(node.target) if isinstance(part, ast.Name))
        elif isinstance(node, ast.While):
            yield from assignments_in(node.body).assigned
        elif isinstance(node, ast.arg):
            yield node.arg


def results(body: Iterable[ast.stmt]) -> Iterator[ast.expr]:
    """Yield the values that a function returns or yields."""
    for node in (part for statement in body for part in ast.walk(statement)):
        if isinstance(node, (ast.Return, ast.Yield)) and node.value is not None:
            yield node.value


def _handed_on(node: ast.AST) -> Iterator[tuple[ast.expr, ast.expr]]:
    """Yield the places to which a statement or an expression hands values on, with these values."""
    yield from assigned_values(node)
    match node:
        case ast.AugAssign(target, _, value) | ast.NamedExpr(target, value):
            yield target, value
        case ast.withitem(ast.Call() as made, ast.expr() as target):
            yield from ((target, value) for value in (made, *made.args, *(one.value for one in made.keywords)))
        case ast.For(ast.Tuple([_, target]), ast.Call(ast.Name("enumerate"), [value, *_])):
            yield target, value
        case ast.For(target, value) | ast.comprehension(target, value):
            if not (isinstance(value, ast.Call) and isinstance(value.func, ast.Name) and value.func.id in _NUMBERED):
                yield target, value
        case ast.Match(subject, cases):
            names = (part for case in cases for part in ast.walk(case.pattern) if isinstance(part, ast.MatchAs))
            yield from ((ast.Name(one.name, ast.Store()), subject) for one in names if one.name is not None)
        case ast.Call(ast.Attribute(held, method), values, keywords) if method in _KEEPS:
            yield from ((held, value) for value in (*values, *(keyword.value for keyword in keywords)))


def _has_entry(held: ast.expr, places: Iterable[str]) -> bool:
    """Whether an entry of a table is one of these places."""
    return any(text.startswith(f"{text_of(held)}[") for text in places)


def _places(target: ast.expr) -> Iterator[ast.expr]:
    """Yield the places of an assignment's target; for an entry whose key is not known, the table."""
    match target:
        case ast.Tuple(targets) | ast.List(targets):
            for one in targets:
                yield from _places(one)
        case ast.Starred(one):
            yield from _places(one)
        case ast.Subscript(held, key) if not isinstance(key, ast.Constant):
            yield held
        case _:
            yield target


def _shared(one: str, other: str, places: Iterable[str]) -> set[str]:
    """Return the places that attributes and entries have under the other one of two names for the same object."""
    found = set()
    for name, further in ((one, other), (other, one)):
        found |= {further + text[len(name) :] for text in places if text.startswith((f"{name}.", f"{name}["))}
    return found


def _is_number(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
