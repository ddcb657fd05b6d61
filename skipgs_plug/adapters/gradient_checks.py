"""Find out whether a function expects that a tensor may have no gradient."""

from __future__ import annotations

import ast
from collections.abc import Iterator


def expects_none(part: ast.AST) -> bool:
    """Whether a part of a function asks whether there is a gradient."""
    return any(isinstance(side, ast.Attribute) and side.attr == "grad" for side in _compared_with_none(part))


def checked_gradients(function: ast.FunctionDef) -> Iterator[ast.expr]:
    """Yield the gradients in a function that it compares with None, also under a name: `grad = means.grad`."""
    compared = {ast.unparse(side) for side in _compared_with_none(function)}
    for node in ast.walk(function):
        match node:
            case ast.Assign([ast.Name(name)], ast.Attribute(attr="grad") as value) if name in compared:
                yield value
            case ast.Attribute(attr="grad") if ast.unparse(node) in compared:
                yield node


def _compared_with_none(part: ast.AST) -> Iterator[ast.expr]:
    """Yield what a part of a function compares with None, but not in an `assert`: it expects no None."""
    asserted = {inner for node in ast.walk(part) if isinstance(node, ast.Assert) for inner in ast.walk(node)}
    for node in ast.walk(part):
        if isinstance(node, ast.Compare) and node not in asserted:
            sides = [node.left, *node.comparators]
            if any(isinstance(side, ast.Constant) and side.value is None for side in sides):
                yield from sides
