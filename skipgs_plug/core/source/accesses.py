"""Accesses: attributes and entries that are read or assigned by a function of the user's, as properties are."""

from __future__ import annotations

import ast
import functools
import inspect
from collections.abc import Callable
from types import FunctionType


def access(
    node: ast.AST, assigned: ast.expr | None, class_of: Callable[[ast.expr], type]
) -> tuple[ast.Call | None, FunctionType | None]:
    """Return the call that an attribute or entry makes, with the object as first argument; None if it makes none.

    A property calls its getter, or the function that sets it. An entry calls `__getitem__` or `__setitem__`.

    Args:
        node: The attribute or entry.
        assigned: The value that is assigned to it; None if it is read.
        class_of: Returns the class of an object, by its expression.
    """
    values = [] if assigned is None else [assigned]
    match node:
        case ast.Attribute(holder, name):
            found = inspect.getattr_static(class_of(holder), name, None)
            called, given = node, [holder, *values]
            function = (found.fset if values else found.fget) if isinstance(found, property) else None
            if isinstance(found, functools.cached_property) and not values:
                function = found.func
        case ast.Subscript(holder, key):
            method = "__setitem__" if values else "__getitem__"
            called, given = ast.copy_location(ast.Attribute(holder, method, ast.Load()), node), [holder, key, *values]
            function = inspect.getattr_static(class_of(holder), method, None)
        case _:
            return None, None
    if not isinstance(function, FunctionType):
        return None, None
    return ast.copy_location(ast.Call(called, given, []), node), function
