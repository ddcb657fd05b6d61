"""Bindings: the values that an assignment gives to names, a call to parameters, and a new object to its attributes."""

from __future__ import annotations

import ast
import copy
import dataclasses
import inspect
import itertools
from collections.abc import Callable, Iterator
from types import FunctionType, MethodType
from typing import Any

from skipgs_plug.core.source.functions import syntax_of, undecorated
from skipgs_plug.core.source.rewriting import Renamed

_VALUES = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


def assigned_values(statement: ast.AST) -> Iterator[tuple[ast.expr, ast.expr]]:
    """Yield the names, attributes and entries that a statement assigns, with their values."""
    match statement:
        case ast.AnnAssign(target, _, ast.expr() as value):
            yield target, value
        case ast.Assign([ast.Tuple(targets)], ast.Tuple(values)) if len(targets) == len(values):
            yield from zip(targets, values, strict=True)
        case ast.Assign([ast.Tuple([whole, rest])], ast.Call(ast.Name("divmod"), [number, by], [])):
            yield whole, ast.copy_location(ast.BinOp(number, ast.FloorDiv(), by), statement.value)
            yield rest, ast.copy_location(ast.BinOp(number, ast.Mod(), by), statement.value)
        case ast.Assign([ast.Tuple(targets)], ast.Name() as held):
            before_star = itertools.takewhile(lambda target: not isinstance(target, ast.Starred), targets)
            yield from ((target, _entry(held, index)) for index, target in enumerate(before_star))
        case ast.Assign(targets, value):
            yield from ((target, value) for target in targets)


def spread(call: ast.Call) -> ast.Call:
    """Return a call with `*(a, b)` and `**{"c": d}` written as the arguments that they stand for."""
    values: list[ast.expr] = []
    for value in call.args:
        match value:
            case ast.Starred(ast.Tuple(shown) | ast.List(shown)):
                values += shown
            case _:
                values.append(value)
    keywords: list[ast.keyword] = []
    for keyword in call.keywords:
        entries = None if keyword.arg is not None else _entries(keyword.value)
        keywords += [keyword] if entries is None else [ast.keyword(name, one) for name, one in entries.items()]
    return ast.copy_location(ast.Call(call.func, values, keywords), call)


def arguments(call: ast.Call, signature: inspect.Signature) -> dict[str, ast.expr]:
    """Return the arguments of a call by parameter, as far as the source shows them.

    Further arguments are a tuple for `*args`, and a dictionary for `**kwargs`. An argument without default that
    `**table` hides is the table's entry with the name of the parameter.
    """
    call, parameters = spread(call), signature.parameters
    values = [*itertools.takewhile(lambda value: not isinstance(value, ast.Starred), call.args)]
    places = [name for name, one in parameters.items() if one.kind in _VALUES]
    given = dict(zip(places, values, strict=False))
    given |= {one.arg: one.value for one in call.keywords if one.arg is not None and one.arg in parameters}
    further = [one for one in call.keywords if one.arg is not None and one.arg not in parameters]
    tables = [one.value for one in call.keywords if one.arg is None]
    all_values = len(values) == len(call.args)
    for name, one in parameters.items():
        if one.kind is one.VAR_POSITIONAL and all_values:
            given[name] = _placed(ast.Tuple(values[len(places) :], ast.Load()), call)
        elif one.kind is one.VAR_KEYWORD and not tables:
            keys: list[ast.expr | None] = [ast.Constant(keyword.arg) for keyword in further]
            given[name] = _placed(ast.Dict(keys, [keyword.value for keyword in further]), call)
        elif one.kind is one.VAR_KEYWORD and not further:
            given |= {name: tables[0]} if len(tables) == 1 else {}
        elif name not in given and one.default is one.empty and len(tables) == 1 and all_values:
            given[name] = _entry(tables[0], name)
    return given


def handed_over(call: ast.Call, is_function: Callable[[ast.expr], bool]) -> ast.Call | None:
    """Return the call that will be made of a function that is an argument, as in `submit(function, step)`.

    Its arguments are those after the function. A tuple or dictionary stands for the arguments that it holds, as in
    `Thread(target=function, args=(step,))`.

    Args:
        call: A call in the source.
        is_function: Whether an argument is a function.
    """
    given = [*call.args, *(one.value for one in call.keywords)]
    index = next((index for index, one in enumerate(given) if is_function(one)), None)
    if index is None:
        return None
    made = ast.Call(given[index], [], [one for one in call.keywords if one.value is not given[index]])
    held: list[ast.expr] = [*call.args[index + 1 :], *(one.value for one in made.keywords)]
    for one in held:
        entries = _entries(one)
        if entries is not None:
            made.keywords += [ast.keyword(name, value) for name, value in entries.items()]
        elif isinstance(one, (ast.Tuple, ast.List)):
            made.args += one.elts
        elif one in call.args:
            made.args.append(one)
    return ast.copy_location(made, call)


def held_in(name: str, value: ast.expr, class_of: Callable[[ast.Call], Any]) -> dict[str, ast.expr]:
    """Return the values that a name holds, as source text: its own, and those of its entries and attributes.

    Args:
        name: The name, attribute or entry.
        value: A value that it has. Entries of new dictionaries, tuples and lists, and attributes of new objects that
            hold an argument of their class, are values too.
        class_of: Returns the class that a call makes an object of; another value if it makes none.
    """
    entries = _entries(value)
    if entries is not None:
        return {f"{name}[{key!r}]": one for key, one in entries.items()}
    if isinstance(value, (ast.Tuple, ast.List)):
        before_star = itertools.takewhile(lambda one: not isinstance(one, ast.Starred), value.elts)
        return {name: value} | {f"{name}[{index}]": one for index, one in enumerate(before_star)}
    if isinstance(value, ast.Call) and inspect.isclass(cls := class_of(value)):
        return {name: value} | {f"{name}.{attribute}": one for attribute, one in _attributes(value, cls).items()}
    return {name: value}


def initialiser(call: ast.Call, cls: type) -> tuple[ast.Call, MethodType | FunctionType | None]:
    """Return the method of the user's that sets up a new object, and its call; None without such a method.

    It is `__init__` of an object whose attributes are not set, or `__post_init__(object, ...)` of a dataclass.

    Args:
        call: The call that makes the object.
        cls: Its class.
    """
    after = inspect.getattr_static(cls, "__post_init__", None)
    if dataclasses.is_dataclass(cls) and isinstance(after, FunctionType):
        further = inspect.signature(after).parameters
        given = arguments(call, inspect.signature(cls)).items()
        passed = [ast.keyword(name, value) for name, value in given if name in further]
        return ast.copy_location(ast.Call(call.func, [call], passed), call), after
    found = inspect.getattr_static(cls, "__init__", None)
    # An object without attributes cannot run `__del__`.
    plain = cls.__new__ is object.__new__ and not hasattr(cls, "__del__") and not inspect.isabstract(cls)
    return call, MethodType(found, object.__new__(cls)) if isinstance(found, FunctionType) and plain else None


def _attributes(call: ast.Call, cls: type) -> dict[str, ast.expr]:
    """Return the attributes of a new object that hold values of the arguments of its class.

    They are those to which `__init__` assigns parameters, constants, or values computed from them. Without a source of
    `__init__`, as for a dataclass or a namespace, attributes are named like parameters.
    """
    try:
        given = arguments(call, inspect.signature(cls))
    except (TypeError, ValueError):  # a class that is not written in Python
        given = {}
    init = undecorated(inspect.getattr_static(cls, "__init__", None))
    syntax = None if init is None else syntax_of(init)
    if syntax is None:
        return given | {keyword.arg: keyword.value for keyword in spread(call).keywords if keyword.arg is not None}
    own = syntax.args.args[0].arg if syntax.args.args else None
    found = {}
    for target, value in (pair for statement in syntax.body for pair in assigned_values(statement)):
        read = {part.id for part in ast.walk(value) if isinstance(part, ast.Name)}
        match target:
            case ast.Attribute(ast.Name(holder), attribute) if holder == own and read <= given.keys():
                found[attribute] = Renamed(given).visit(copy.deepcopy(value))
    return found


def _entries(value: ast.expr) -> dict[Any, ast.expr] | None:
    """Return the entries of a new dictionary whose keys are constants; None for any other value."""
    match value:
        case ast.Dict(keys, values):
            pairs = zip(keys, values, strict=True)
            return {key.value: one for key, one in pairs if isinstance(key, ast.Constant)}
        case ast.Call(ast.Name("dict"), [], keywords):
            return {keyword.arg: keyword.value for keyword in keywords if keyword.arg is not None}
    return None


def _entry(held: ast.expr, key: Any) -> ast.expr:
    return _placed(ast.Subscript(held, ast.Constant(key), ast.Load()), held)


def _placed(node: ast.expr, at: ast.expr) -> ast.expr:
    """Return a node with the position of another one."""
    return ast.fix_missing_locations(ast.copy_location(node, at))
