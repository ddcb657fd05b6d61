"""Finds the function that a call in a trainer's source names, and the syntax of that function."""

from __future__ import annotations

import ast
import contextlib
import functools
import inspect
import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from types import CodeType, FunctionType, MethodType
from typing import Any

import torch

from skipgs_plug.core.source.run_options import is_plain, text_of

# Largest number of objects that are read one by one. Lists of callbacks are shorter, and lists of cameras longer.
MOST_CALLBACKS = 16


def callbacks(held: Any) -> Sequence[Any]:
    """Return the entries of a short list of functions or objects; nothing for any other value."""
    held = [*held] if isinstance(held, torch.nn.ModuleList) else held
    return held if isinstance(held, (list, tuple)) and len(held) <= MOST_CALLBACKS and not is_plain(held) else ()


def value_of(place: ast.expr, names: Mapping[str, Any], unknown: Collection[str]) -> Any:
    """Return the value that a name, attribute or entry has before the loop and in it; None if unknown.

    Args:
        place: The name, attribute or entry, as an expression such as `table["key"]` or `table.get("key")`, or all
            entries as `table.values()`. Properties are not evaluated.
        names: Names and values before the loop.
        unknown: Names and attributes that the loop assigns.
    """
    if text_of(place) in unknown:
        return None
    match place:
        case ast.Name(name):
            return names.get(name)
        case ast.Attribute(holder, name) | ast.Call(ast.Name("getattr"), [holder, ast.Constant(str(name)), *_]):
            found = _member(value_of(holder, names, unknown), name)
            return None if hasattr(type(found), "__get__") else found
        case ast.Subscript(holder, ast.Constant(key)) | ast.Call(ast.Attribute(holder, "get"), [ast.Constant(key), *_]):
            held = value_of(holder, names, unknown)
            return held.get(key) if isinstance(held, dict) else None
        case ast.Call(ast.Attribute(holder, "values"), []):
            held = value_of(holder, names, unknown)
            return [*held.values()] if isinstance(held, dict) else None
    return None


def called_function(
    function: ast.expr, names: Mapping[str, Any], value: Callable[[ast.expr], Any], code: CodeType | None = None
) -> Any:
    """Return the function that an expression names; None if it is unknown. Properties are not evaluated.

    For an object that can be called, this is its method `__call__`, and for a module of PyTorch its `forward`.

    Args:
        function: The expression before the brackets of the call.
        names: Names and values where the call is.
        value: Returns the value of an expression there; None if it is unknown.
        code: Code of the function that makes the call, for `super()`; None outside of methods.
    """
    found = _named(function, names, value, code)
    method = "forward" if isinstance(found, torch.nn.Module) else "__call__"
    own = inspect.getattr_static(type(found), method, None)
    return MethodType(own, found) if isinstance(own, FunctionType) else found


def without_partial(call: ast.Call, function: Any, named: Callable[[str, Any], ast.expr]) -> tuple[ast.Call, Any]:
    """Return the call that a `functools.partial` makes, and its function; another function and its call as they are.

    Args:
        call: The call in the source.
        function: The function that it names.
        named: Gives a value a name, and returns the name as an expression.
    """
    if not isinstance(function, functools.partial):
        return call, function
    called, given = ast.unparse(call.func), {keyword.arg for keyword in call.keywords}

    def at_call(part: str, value: Any) -> ast.expr:
        return ast.copy_location(named(f"{called}.{part}", value), call)

    first = [at_call(f"args[{index}]", value) for index, value in enumerate(function.args)]
    further = [
        ast.keyword(name, at_call(f"keywords[{name!r}]", value))
        for name, value in function.keywords.items()
        if name not in given
    ]
    return ast.Call(call.func, [*first, *call.args], [*call.keywords, *further]), function.func


def _member(owner: Any, name: str) -> Any:
    """Return an attribute, or a module inside a module of PyTorch, without evaluating properties; None without it."""
    inside = vars(owner).get("_modules", {}) if isinstance(owner, torch.nn.Module) else {}
    return inside[name] if name in inside else inspect.getattr_static(owner, name, None)


def _named(
    function: ast.expr, names: Mapping[str, Any], value: Callable[[ast.expr], Any], code: CodeType | None
) -> Any:
    match function:
        case ast.Name(name):
            return names.get(name)
        case ast.Attribute(ast.Call(ast.Name("super"), []), name):
            return _inherited(name, names.get("self"), code)
        case ast.Attribute(place, name) | ast.Call(ast.Name("getattr"), [place, ast.Constant(str(name)), *_]):
            owner = value(place)
            found = _member(owner, name)
            if isinstance(found, FunctionType) and not inspect.isclass(owner) and not inspect.ismodule(owner):
                in_class = inspect.getattr_static(type(owner), name, None) is found
                return MethodType(found, owner) if in_class else found
            if isinstance(found, classmethod):
                return MethodType(found.__func__, owner if inspect.isclass(owner) else type(owner))
            return found.__func__ if isinstance(found, staticmethod) else found
    return value(function)


def _inherited(name: str, owner: Any, code: CodeType | None) -> Any:
    """Return the method that `super().name` names in the method with this code."""
    above = iter(type(owner).__mro__)
    for cls in above:
        own = undecorated(vars(cls).get(name))
        if own is not None and own.__code__ is code:
            break
    found = next((vars(cls)[name] for cls in above if isinstance(vars(cls).get(name), FunctionType)), None)
    return None if found is None else MethodType(found, owner)


def undecorated(function: Any) -> FunctionType | None:
    """Return the function under its decorators, even without `functools.wraps`; None if it is not a Python function."""
    function = function.__func__ if isinstance(function, MethodType) else function
    if not isinstance(function, (FunctionType, functools._lru_cache_wrapper)):
        return None
    function = inspect.unwrap(function)
    if not isinstance(function, FunctionType):
        return undecorated(function) if isinstance(function, MethodType) else None  # a gate wraps bound methods
    for held in closure(function).values():
        if isinstance(held, FunctionType) and held.__name__ == function.__name__ and held is not function:
            return undecorated(held)
    return function


def closure(function: Any) -> dict[str, Any]:
    """Return names and values of the variables that a function shares with the function around it, if they are set."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    held: dict[str, Any] = {}
    for name, cell in cells:
        with contextlib.suppress(ValueError):  # not set yet
            held[name] = cell.cell_contents
    return held


def returns_owner(method: Any) -> bool:
    """Whether a method returns its own object, as `__enter__` mostly does."""
    function = undecorated(method)
    syntax = None if function is None else syntax_of(function)
    match syntax:
        case ast.FunctionDef(args=ast.arguments(args=[owner, *_]), body=[*_, ast.Return(ast.Name(name))]):
            return name == owner.arg
    return False


def read_syntax(function: FunctionType) -> ast.FunctionDef | None:
    """Return the syntax of a function, whose first line is line 1; None if there is no source.

    A lambda is returned as a function that returns its expression, and an `async` function as one without `async`.
    """
    if function.__name__ == "<lambda>":
        return _lambda_syntax(function)
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function.__code__)))  # not that of a function inside it
    except (OSError, TypeError, ValueError, SyntaxError):
        return None
    name = function.__code__.co_name
    definitions = (node for node in tree.body if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)))
    found = next((node for node in definitions if node.name == name), None)
    if isinstance(found, ast.AsyncFunctionDef):
        return ast.copy_location(ast.FunctionDef(**dict(ast.iter_fields(found))), found)
    return found


def _lambda_syntax(function: FunctionType) -> ast.FunctionDef | None:
    """Return the syntax of a lambda; None without source, or if its line has another one with these parameters."""
    first, parameters = function.__code__.co_firstlineno, [*inspect.signature(function).parameters]
    try:
        tree = ast.parse("".join(inspect.findsource(function)[0]))
    except (OSError, SyntaxError):
        return None
    lambdas = [node for node in ast.walk(tree) if isinstance(node, ast.Lambda) and node.lineno == first]
    found = [node for node in lambdas if [one.arg for one in _parameters(node.args)] == parameters]
    if len(found) != 1:
        return None
    body: list[ast.stmt] = [ast.copy_location(ast.Return(found[0].body), found[0].body)]
    syntax = ast.copy_location(ast.FunctionDef("lambda", found[0].args, body, []), found[0])
    return ast.increment_lineno(syntax, 1 - first)


def _parameters(arguments: ast.arguments) -> list[ast.arg]:
    starred = ([arguments.vararg], arguments.kwonlyargs, [arguments.kwarg])
    further = [one for part in starred for one in part if one is not None]
    return [*arguments.posonlyargs, *arguments.args, *further]


syntax_of = functools.lru_cache(maxsize=1024)(read_syntax)  # the same tree each time, which nobody may change
