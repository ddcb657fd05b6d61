"""What the statements of a loop assign and change."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from skipgs_plug.core.pace.in_place import PLACES, comprehended
from skipgs_plug.core.pace.spelled_out import always

# Methods that change lists, sets and queues, so that an object can differ from iteration to iteration.
CHANGES = frozenset({"add", "append", "appendleft", "clear", "discard", "extend", "insert", "pop", "popleft", "remove"})
# Methods that change dictionaries. Other objects have methods of the same names for other purposes.
CHANGES_OPTIONS = frozenset({"popitem", "setdefault", "update"})


class Stores(NamedTuple):
    """What statements assign and change, as source text.

    Attributes:
        assigned: Names, attributes and entries that they assign, once for each assignment.
        changed: Those, and objects of which they call one of `CHANGES`.
        options: Lists and dictionaries whose entries they assign, and objects of which they call `CHANGES_OPTIONS`.
    """

    assigned: list[str]
    changed: set[str]
    options: set[str]


def stores(body: Iterable[ast.stmt]) -> Stores:
    """Return what these statements assign and change."""
    parts = [node for one in body for node in ast.walk(one)]
    inner = set(map(id, comprehended(parts)))
    stored = [node for node in parts if isinstance(node, PLACES) and not isinstance(node.ctx, ast.Load)]
    assigned = [ast.unparse(node) for node in stored if id(node) not in inner]
    called = [node.func for node in parts if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]
    changed = {ast.unparse(method.value) for method in called if method.attr in CHANGES}
    options = {ast.unparse(method.value) for method in called if method.attr in CHANGES_OPTIONS}
    options |= {ast.unparse(node.value) for node in stored if isinstance(node, ast.Subscript)}
    return Stores(assigned, changed.union(assigned), options)


def counted(body: list[ast.stmt]) -> Iterator[str]:
    """Yield the names and attributes to which these statements add a constant in every iteration."""
    for node in always(body):
        if isinstance(node, ast.AugAssign) and isinstance(node.op, ast.Add) and isinstance(node.value, ast.Constant):
            yield ast.unparse(node.target)
