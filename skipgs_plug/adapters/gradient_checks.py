"""Find out whether a function expects that a tensor may have no gradient."""

from __future__ import annotations

import ast
from collections.abc import Iterator


def expects_none(function: ast.FunctionDef) -> bool:
    """Whether a function asks somewhere whether there is a gradient."""
    return any(isinstance(side, ast.Attribute) and side.attr == "grad" for side in _compared_with_none(function))


def checked_gradients(function: ast.FunctionDef) -> Iterator[ast.expr]:
    """Yield the gradients in a function that it gives a name, as in `grad = means.grad`, `if grad is None`."""
    names = {side.id for side in _compared_with_none(function) if isinstance(side, ast.Name)}
    for statement in ast.walk(function):
        match statement:
            case ast.Assign([ast.Name(name)], ast.Attribute(attr="grad") as value) if name in names:
                yield value


def _compared_with_none(function: ast.FunctionDef) -> Iterator[ast.expr]:
    """Yield what a function compares with None, but not in an `assert`: it expects no None."""
    asserted = {part for node in ast.walk(function) if isinstance(node, ast.Assert) for part in ast.walk(node)}
    for node in ast.walk(function):
        if isinstance(node, ast.Compare) and node not in asserted:
            sides = [node.left, *node.comparators]
            if any(isinstance(side, ast.Constant) and side.value is None for side in sides):
                yield from sides
