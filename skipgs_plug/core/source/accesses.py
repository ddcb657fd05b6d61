"""Accesses: attributes and entries that are read or assigned by a function of the user's, as properties are."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any


def access(
    node: ast.AST, assigned: ast.expr | None, value: Callable[[ast.expr], Any]
) -> tuple[ast.Call | None, MethodType | None]:
    """Return the call that an attribute or entry makes, and the bound method; None if it makes none.

    A property calls its getter, or the function that sets it. An entry calls `__getitem__` or `__setitem__`.

    Args:
        node: The attribute or entry.
        assigned: The value that is assigned to it; None if it is read.
        value: Returns the value of an expression before the loop; None if it is unknown.
    """
    values = [] if assigned is None else [assigned]
    match node:
        case ast.Attribute(holder, name):
            owner = value(holder)
            found = inspect.getattr_static(type(owner), name, None)
            called, given = node, values
            function = (found.fset if values else found.fget) if isinstance(found, property) else None
        case ast.Subscript(holder, key):
            owner, method = value(holder), "__setitem__" if values else "__getitem__"
            called, given = ast.copy_location(ast.Attribute(holder, method, ast.Load()), node), [key, *values]
            function = inspect.getattr_static(type(owner), method, None)
        case _:
            return None, None
    if not isinstance(function, FunctionType):
        return None, None
    return ast.copy_location(ast.Call(called, given, []), node), MethodType(function, owner)
