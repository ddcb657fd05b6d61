"""Calls whose function is chosen while a loop runs, as in `getattr(self, f"on_{name}")(step)`."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Collection, Iterable
from types import CodeType, FunctionType, MethodType
from typing import Any

from skipgs_plug.core.source.functions import syntax_of, undecorated
from skipgs_plug.core.source.project import Project
from skipgs_plug.core.source.reach import compared, remainders


def chooses_decision(
    function: ast.expr, value: Callable[[ast.expr], Any], project: Project, known: Collection[CodeType]
) -> bool:
    """Whether a call may be one of a function of the user's with conditions on remainders or single numbers.

    Args:
        function: The expression before the brackets of the call.
        value: Returns the value of an expression before the loop; None if it is unknown.
        project: The user's project.
        known: Code of functions that are read anyway.
    """
    choice = _choice(function, value, project)
    if choice is None:
        return not isinstance(function, ast.Lambda)
    plain = (one for one in map(undecorated, choice) if one is not None)
    return any(_decides(syntax_of(one)) for one in plain if one in project and one.__code__ not in known)


def is_hidden(function: Any, plain: FunctionType, is_read: bool, project: Project) -> bool:
    """Whether a function of the user's, or its decorator, has such conditions and is not read.

    Args:
        function: The function that is called.
        plain: The function under its decorators.
        is_read: Whether that one is read.
        project: The user's project.
    """
    outer = function.__func__ if isinstance(function, MethodType) else function
    around = isinstance(outer, FunctionType) and outer is not plain and outer in project
    syntax = syntax_of(plain)
    return (around and _decides(syntax_of(outer))) or (not is_read and (syntax is None or _decides(syntax)))


def _choice(function: ast.expr, value: Callable[[ast.expr], Any], project: Project) -> Iterable[Any] | None:
    """Return the values that an expression may have; None if they are not known."""
    match function:
        case ast.Attribute(_, name):  # a method of an unknown object
            return project.methods(name)
        case ast.Subscript(table, key) | ast.Call(ast.Attribute(table, "get"), [key, *_]):
            held = value(table)
            if isinstance(held, dict):
                return [held.get(key.value)] if isinstance(key, ast.Constant) else [*held.values()]
            return held if isinstance(held, (list, tuple)) else None
        case ast.Call(ast.Name("getattr"), [owner, name, *_]):
            held, pattern = value(owner), _pattern(name)
            members = (member for cls in type(held).__mro__ for member in vars(cls).items())
            return None if held is None else [one for text, one in members if re.fullmatch(pattern, text)]
    return None


def _pattern(name: ast.expr) -> str:
    """Return a pattern of the texts that an expression may have."""
    match name:
        case ast.Constant(str(text)):
            return re.escape(text)
        case ast.JoinedStr(parts):
            return "".join(map(_pattern, parts))
        case ast.BinOp(first, ast.Add(), second):
            return _pattern(first) + _pattern(second)
    return ".*"


def _decides(function: ast.FunctionDef | None) -> bool:
    parts = () if function is None else ast.walk(function)
    tests = (part for part in parts if isinstance(part, (ast.BinOp, ast.Compare)))
    return any(next(remainders(test), None) or next(compared(test), None) for test in tests)
