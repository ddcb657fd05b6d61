"""Parts of a loop that only advance a progress bar: no iteration must run for them, and the gate advances the bar."""

from __future__ import annotations

import ast
from collections.abc import Container, Iterator, Mapping
from typing import Any, NamedTuple

from skipgs_plug.core.source.conditions import is_inside

# Methods of a progress bar that show text, and the method that advances it.
SHOWS = frozenset({"refresh", "set_description", "set_description_str", "set_postfix", "set_postfix_str"})
MOVES = "update"
# Functions and methods that only read their arguments, and that loops call for the text beside a bar.
LOOKS = frozenset({"abs", "bool", "float", "format", "int", "len", "max", "min", "repr", "round", "str", "sum"})
LOOKING = frozenset({"cpu", "detach", "format", "item", "join", "numel", "size", "tolist"})
_VALUES = (
    *(ast.Attribute, ast.BinOp, ast.BoolOp, ast.Compare, ast.Constant, ast.Dict, ast.FormattedValue, ast.IfExp),
    *(ast.JoinedStr, ast.List, ast.Name, ast.Slice, ast.Subscript, ast.Tuple, ast.UnaryOp),
    *(ast.boolop, ast.cmpop, ast.expr_context, ast.keyword, ast.operator, ast.unaryop),
)


class Moves(NamedTuple):
    """A progress bar that the loop advances by hand.

    Attributes:
        bar: The bar of tqdm.
        by: Number that each of the iterations adds.
        numbers: The iterations that advance the bar.
    """

    bar: Any
    by: float
    numbers: Container[int]


class Bars:
    """Advances bars for iterations that are left out, so that they end at their total."""

    def __init__(self, moves: list[Moves]) -> None:
        self._moves = moves
        self._behind = [0.0] * len(moves)

    def left_out(self, number: int) -> None:
        for index, one in enumerate(self._moves):
            if number in one.numbers:
                self._behind[index] += one.by

    def catch_up(self) -> None:
        """Advance the bars. Call it before an iteration runs, because the iteration may close a bar."""
        for index, one in enumerate(self._moves):
            if self._behind[index]:
                one.bar.update(self._behind[index])
                self._behind[index] = 0


def is_bar(node: ast.AST, names: Mapping[str, Any]) -> bool:
    """Whether this is the name of a progress bar of tqdm."""
    return isinstance(node, ast.Name) and any(
        kind.__module__.partition(".")[0] == "tqdm" for kind in type(names.get(node.id)).__mro__
    )


def outermost_bar_ifs(body: list[ast.stmt], names: Mapping[str, Any], around: ast.AST) -> list[ast.If]:
    """Return each `if` that only advances a progress bar, without those inside another one."""
    found: list[ast.If] = []
    for node in (part for statement in body for part in ast.walk(statement)):  # outer statements come first
        if not isinstance(node, ast.If) or any(is_inside(node, outer) for outer in found):
            continue
        if only_shows(node, names, around):
            found.append(node)
    return found


def only_shows(statement: ast.If, names: Mapping[str, Any], around: ast.AST) -> bool:
    """Whether the branches of an `if` only advance a progress bar and set the text beside it.

    Printed text is a record that somebody may read, so an `if` that prints does more than that.

    Args:
        statement: The `if`.
        names: Names and values that the function had before the loop.
        around: Syntax tree of the function. Variables that a branch assigns must not be read elsewhere in it.
    """
    if not any(isinstance(part, ast.Call) and _is_bars(part, names) for part in ast.walk(statement)):
        return False
    inside = {id(part) for part in ast.walk(statement)}
    read = {
        part.id
        for part in ast.walk(around)
        if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Load) and id(part) not in inside
    }
    only = all(_shows(one, names, read) for one in [*statement.body, *statement.orelse])
    return only and not any(_moves_inside(one, names) for one in statement.orelse)


def moves(body: list[ast.stmt], names: Mapping[str, Any]) -> Iterator[tuple[Any, float]]:
    """Yield each bar that these statements advance themselves, not in blocks inside them, and the number they add."""
    for one in body:
        if isinstance(one, ast.Expr) and _is_move(one.value, names):
            call = one.value
            assert isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute)
            assert isinstance(call.func.value, ast.Name)
            yield names[call.func.value.id], ast.literal_eval(call.args[0]) if call.args else 1


def _is_move(node: ast.AST, names: Mapping[str, Any]) -> bool:
    if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == MOVES):
        return False
    by = node.args[0] if node.args else ast.Constant(1)
    plain = isinstance(by, ast.Constant) and isinstance(by.value, (int, float))
    return is_bar(node.func.value, names) and plain and len(node.args) < 2 and not node.keywords


def _is_bars(call: ast.Call, names: Mapping[str, Any]) -> bool:
    return isinstance(call.func, ast.Attribute) and is_bar(call.func.value, names)


def _moves_inside(statement: ast.stmt, names: Mapping[str, Any]) -> bool:
    return any(_is_move(part, names) for part in ast.walk(statement))


def _shows(statement: ast.stmt, names: Mapping[str, Any], read: Container[str]) -> bool:
    if isinstance(statement, ast.Pass):
        return True
    if isinstance(statement, ast.If):
        parts = [*statement.body, *statement.orelse]
        return _looks(statement.test) and all(
            _shows(one, names, read) and not _moves_inside(one, names) for one in parts
        )
    if isinstance(statement, ast.Assign):
        kept = all(isinstance(one, ast.Name) and one.id not in read for one in statement.targets)
        return kept and _looks(statement.value)
    if not (isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Call)):
        return False
    call = statement.value
    if _is_move(call, names):
        return True
    shows = isinstance(call.func, ast.Attribute) and call.func.attr in SHOWS and _is_bars(call, names)
    return shows and all(map(_looks, [*call.args, *(keyword.value for keyword in call.keywords)]))


def _looks(node: ast.expr) -> bool:
    """Whether an expression only reads values."""
    for part in ast.walk(node):
        if isinstance(part, ast.Call):
            name = part.func.id if isinstance(part.func, ast.Name) else ""
            method = part.func.attr if isinstance(part.func, ast.Attribute) else ""
            if name not in LOOKS and method not in LOOKING:
                return False
        elif not isinstance(part, _VALUES):
            return False
    return True
