"""Names and objects that the statements of a loop assign and change."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from skipgs_plug.core.source.names import PLACES
from skipgs_plug.core.source.run_options import comprehended, text_of

# Methods that change lists, sets and queues, so that an object can differ from iteration to iteration.
SHRINKS = frozenset({"clear", "discard", "pop", "popleft", "remove"})
CHANGES = SHRINKS | {"add", "append", "appendleft", "extend", "insert"}
# Methods that change dictionaries. Other objects have methods of the same names for other purposes.
CHANGES_OPTIONS = frozenset({"popitem", "setdefault", "update"})


class Assignments(NamedTuple):
    """Names and objects that statements assign and change, as source text.

    Attributes:
        assigned: Names, attributes and entries that they assign, once for each assignment.
        changed: The same, and objects whose methods in `CHANGES` they call.
        shrunk: Objects whose methods in `SHRINKS` they call.
        options: Lists and dictionaries whose entries they assign, and objects whose methods in `CHANGES_OPTIONS` they
            call.
    """

    assigned: list[str]
    changed: set[str]
    options: set[str]
    shrunk: set[str]

    def possible(self, names: Mapping[str, Any]) -> Assignments:
        """Return these without calls of methods of what is None, as in `if writer is not None: writer.add(...)`.

        Args:
            names: Names and values before the loop.
        """
        none = {name for name, value in names.items() if value is None}.difference(self.assigned)
        return self._replace(changed=self.changed - none, options=self.options - none)


def assignments_in(body: Iterable[ast.stmt], is_off: Callable[[ast.expr], bool] = lambda test: False) -> Assignments:
    """Return the names and objects that these statements assign and change.

    Args:
        body: The statements.
        is_off: Whether a condition never holds, so that no iteration runs the statements under it.
    """
    parts = [node for one in body for node in _reached(one, is_off)]
    inner = set(map(id, comprehended(parts)))
    stored = [node for node in parts if isinstance(node, PLACES) and not isinstance(node.ctx, ast.Load)]
    assigned = [text_of(node) for node in stored if id(node) not in inner]
    called = [node.func for node in parts if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]
    changed = {ast.unparse(method.value) for method in called if method.attr in CHANGES}
    options = {ast.unparse(method.value) for method in called if method.attr in CHANGES_OPTIONS}
    options |= {ast.unparse(node.value) for node in stored if isinstance(node, ast.Subscript)}
    shrunk = {ast.unparse(method.value) for method in called if method.attr in SHRINKS}
    return Assignments(assigned, changed.union(assigned), options, shrunk)


def _reached(node: ast.AST, is_off: Callable[[ast.expr], bool]) -> Iterator[ast.AST]:
    """Iterate over a part of the source and all parts inside it, except the blocks of an `if` that never run."""
    yield node
    inside: Iterable[ast.AST] = ast.iter_child_nodes(node)
    if isinstance(node, ast.If):
        blocks = (node.test, node.body), (ast.UnaryOp(ast.Not(), node.test), node.orelse)
        inside = [node.test, *(one for test, block in blocks if block and not is_off(test) for one in block)]
    for child in inside:
        yield from _reached(child, is_off)
