"""Names in the source of a function: those that it binds, and those of the objects whose parts it reads."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator

from skipgs_plug.core.source.run_options import comprehended

PLACES = (ast.Name, ast.Attribute, ast.Subscript)  # syntax that holds a value, and that an assignment may have
_DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
# Further syntax that gives a name to a value; names that are assigned are `ast.Name`.
_BINDS_NAME = (*_DEFINITIONS, ast.ExceptHandler, ast.MatchAs, ast.MatchStar)


def counted_by(counter: str) -> str:
    """Return the place whose value, or whose length as in `len(losses)`, is a counter, as source text."""
    return counter[4:-1] if counter.startswith("len(") else counter


def holders_of(places: Iterable[str]) -> set[str]:
    """Return the names and places whose attributes or entries these are, as source text."""
    return {text[: end.start()] for text in places for end in re.finditer(r"[.[]", text)}


def bound_in(syntax: ast.FunctionDef) -> set[str]:
    """Return the names that a function gives to values of its own."""
    found: set[str | None] = set()
    shared: set[str] = set()
    inner = set(map(id, comprehended(ast.walk(syntax))))
    for node in ast.walk(syntax):
        if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load) and id(node) not in inner:
            found.add(node.id)
        elif isinstance(node, _BINDS_NAME) and node is not syntax:
            found.add(node.name)
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            found |= {one.asname or one.name.partition(".")[0] for one in node.names}
        elif isinstance(node, (ast.Global, ast.Nonlocal)):
            shared |= set(node.names)
    return {name for name in found if name is not None} - shared


def reached_in(node: ast.AST) -> Iterator[ast.AST]:
    """Iterate over a statement, and the functions but not the classes that it defines; over parts before the whole."""
    if isinstance(node, ast.ClassDef):
        return
    for child in ast.iter_child_nodes(node):
        yield from reached_in(child)
    yield node
