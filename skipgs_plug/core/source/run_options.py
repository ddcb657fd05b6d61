"""Options of a run: parts of a loop's conditions that have one value, before the loop and in all its iterations."""

from __future__ import annotations

import ast
import functools
import inspect
import linecache
import os
import re
import sys
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from types import CodeType, FunctionType
from typing import Any

import torch

from skipgs_plug.core.source.conversions import is_conversion

# Built-in functions that conditions may call. They change nothing.
PURE = frozenset({"abs", "all", "any", "bool", "divmod", "float", "frozenset", "getattr", "int", "isinstance", "len"})
PURE |= {"list", "max", "min", "range", "round", "set", "sorted", "sum", "tuple"}
SET_UP = ("__init__", "__post_init__")  # methods that set up a new object
_UNKNOWN = object()  # stands for a value that is not known; None is a value
# Containers whose length can be an option.
_CONTAINERS = (deque, dict, frozenset, list, range, set, tuple, torch.utils.data.DataLoader, torch.utils.data.Dataset)


class RunOptions:
    """Recognises the options of a run: names that a function has before its loop and that the loop does not assign.

    Only plain values count (numbers, text, flags, None and collections of them), in variables of the function itself,
    in constants of its module, in dictionaries, or in objects without methods, such as a namespace of options. So do
    the arguments and the environment of the process, and whether there is CUDA. Methods
    of other objects, such as a model, may change them; but a part of such an object that is None, and that no method
    assigns, stays None.

    Args:
        code: Code of the function that holds the loop.
        source: Syntax tree of the function, or of the whole module for a loop at module level.
        names: Names and values that the function has before the loop.
        changing: Names and attributes that the loop assigns or changes.
        shared: Further names that other functions may change.
        pure: Names of functions that only read their arguments.
    """

    def __init__(
        self,
        code: CodeType,
        source: ast.AST,
        names: Mapping[str, Any],
        changing: Collection[str],
        shared: Collection[str],
        pure: Collection[str],
    ) -> None:
        declared = (node.names for node in ast.walk(source) if isinstance(node, (ast.Global, ast.Nonlocal)))
        variables = {*code.co_varnames, *code.co_cellvars} - _of_comprehensions(source)
        # A module's own variables are its names.
        self._own = variables if code.co_flags & inspect.CO_NEWLOCALS else {*code.co_names}
        of_module = assigned_globals(code.co_filename) - variables
        self._shared = of_module.union(code.co_freevars, shared, *declared)
        self._names, self._changing, self._pure, self._file = names, changing, pure, code.co_filename

    def __contains__(self, node: object) -> bool:
        """Whether an expression consists of options, constants and functions that only read."""
        return self._holds(node, False)

    def keeps_value(self, node: ast.expr) -> bool:
        """Whether an expression consists of options, and of lengths of containers that the loop does not change.

        Functions that the loop calls can change such a container. So a length may tell how often an iteration is
        needed, but it does not show that a condition never holds.
        """
        return self._holds(node, True)

    def only_reads(self, call: ast.Call) -> bool:
        """Whether a call changes nothing, whatever its arguments are."""
        match call.func:
            case ast.Name(name) if name in self._pure:
                return True
            case ast.Attribute(holder, "get") if isinstance(self._look_up(holder), dict):
                return True
            case ast.Attribute(_, "items" | "keys" | "values") if not call.args and not call.keywords:
                return True
        return is_conversion(call, self._function)

    def _function(self, named: ast.expr) -> Any:
        found = self._look_up(named)
        return None if found is _UNKNOWN else found

    def _holds(self, node: object, lengths: bool) -> bool:
        if isinstance(node, ast.Constant):
            return True
        if isinstance(node, (ast.BoolOp, ast.BinOp, ast.UnaryOp, ast.Compare, ast.IfExp, ast.Tuple, ast.List, ast.Set)):
            return all(self._holds(part, lengths) for part in ast.iter_child_nodes(node) if isinstance(part, ast.expr))
        if not isinstance(node, (ast.Name, ast.Attribute, ast.Subscript, ast.Call)):
            return False
        value = self._look_up(node)
        if isinstance(value, (list, set)) and not self._is_own(node):
            return False  # any function can change it
        if value is not _UNKNOWN or not isinstance(node, ast.Call):
            return is_plain(value) or self._is_absent(node)
        match node:
            case ast.Call(ast.Name("len"), [held]) if lengths and isinstance(self._look_up(held), _CONTAINERS):
                return True
            case ast.Call(_, arguments, []):
                return self.only_reads(node) and all(self._holds(argument, lengths) for argument in arguments)
        return False

    def _is_own(self, node: ast.expr) -> bool:
        """Whether a value is that of a variable of the function itself, or is held by one."""
        root = root_of(node)
        return isinstance(root, ast.Name) and root.id in self._own

    def _is_absent(self, node: ast.expr) -> bool:
        """Whether this is a part of an object that is None, as `self.logger`, and that no function assigns later."""
        if not isinstance(node, ast.Attribute) or text_of(node) in self._changing:
            return False
        holder = self._object(node.value)
        if getattr(holder, "__dict__", {}).get(node.attr, _UNKNOWN) is not None:
            return False
        sources = [linecache.getlines(file) for file in {self._file, *_files_of(type(holder))}]
        return all(lines and node.attr not in _assigned_late("".join(lines)) for lines in sources)

    def _object(self, node: ast.expr) -> Any:
        """Return the value of a name, or of an object's attribute, that the loop does not assign; None if unknown."""
        if text_of(node) in self._changing:
            return None
        match node:
            case ast.Name(name):
                return None if name in self._shared else self._names.get(name)
            case ast.Attribute(holder, name):
                return getattr(self._object(holder), "__dict__", {}).get(name)
        return None

    def _of_process(self, node: ast.expr) -> Any:
        """Return the arguments or the environment of the process, or what a call tells of them; else `_UNKNOWN`."""
        match node:
            case ast.Call(function, [], []) if self._object(function) is torch.cuda.is_available:
                return torch.cuda.is_available()
            case ast.Call(function, [ast.Constant(str(key)), *default], []) if self._object(function) is os.getenv:
                values = [one.value for one in default if isinstance(one, ast.Constant)]
                return os.environ.get(key, *values) if len(values) == len(default) else _UNKNOWN
            case ast.Name() | ast.Attribute():
                found = self._object(node)
                if found is os.environ or found is sys.argv:
                    return dict(found) if found is os.environ else tuple(found)
        return _UNKNOWN

    def _look_up(self, node: ast.expr) -> Any:
        """Return the value of an option, or of an object that holds options; `_UNKNOWN` if it is neither."""
        if text_of(node) in self._changing:
            return _UNKNOWN
        if (setting := self._of_process(node)) is not _UNKNOWN:
            return setting
        match node:
            case ast.Name(name):
                return _UNKNOWN if name in self._shared else self._names.get(name, _UNKNOWN)
            case ast.Attribute(holder, name):
                return _attribute(self._look_up(holder), name, _UNKNOWN)
            case ast.Call(ast.Name("getattr"), [holder, ast.Constant(str(name)), ast.Constant(default)]):
                return _attribute(self._look_up(holder), name, default)
            case ast.Call(ast.Attribute(holder, "get"), [ast.Constant(key)]):
                return _item(self._look_up(holder), key, None)
            case ast.Call(ast.Attribute(holder, "get"), [ast.Constant(key), ast.Constant(default)]):
                return _item(self._look_up(holder), key, default)
            case ast.Subscript(holder, ast.Constant(key)):
                return _item(self._look_up(holder), key, _UNKNOWN)
        return _UNKNOWN


def text_of(place: ast.expr) -> str:
    """Return the source text of a place, as `ast.unparse` does, in less time for names and their attributes."""
    match place:
        case ast.Name(name):
            return name
        case ast.Attribute(ast.Name() | ast.Attribute() as holder, name):
            return f"{text_of(holder)}.{name}"
    return ast.unparse(place)


def root_of(place: ast.expr) -> ast.expr:
    """Return the name, or other expression, whose attribute or entry a place is."""
    while isinstance(place, (ast.Attribute, ast.Subscript)):
        place = place.value
    return place


def assigned_globals(file: str) -> set[str]:
    """Return the global names of a source file that its functions may assign."""
    declared = re.findall(r"\bglobal\s+(\w+(?:\s*,\s*\w+)*)", "".join(linecache.getlines(file)))
    return {name.strip() for names in declared for name in names.split(",")}


def _files_of(cls: type) -> set[str]:
    """Return the source files of the methods of a class, inherited ones included."""
    methods = [vars(one) for one in cls.__mro__]
    files = {one.__code__.co_filename for own in methods for one in own.values() if isinstance(one, FunctionType)}
    return files - {"<string>"}  # methods that `dataclass` writes


@functools.lru_cache(maxsize=64)
def _assigned_late(source: str) -> frozenset[str]:
    """Return the attributes that functions in a source assign, except those that set up a new object."""
    try:
        nodes = [*ast.walk(ast.parse(source))]
    except SyntaxError:
        return frozenset()
    functions = [node for node in nodes if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]
    later = (part for one in functions if one.name not in SET_UP for part in ast.walk(one))
    return frozenset(part.attr for part in later if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store))


def comprehended(nodes: Iterable[ast.AST]) -> Iterator[ast.Name]:
    """Yield the names that comprehensions among these nodes give to their values."""
    for node in nodes:
        if isinstance(node, ast.comprehension):
            yield from (part for part in ast.walk(node.target) if isinstance(part, ast.Name))


def _of_comprehensions(source: ast.AST) -> set[str]:
    """Names that only comprehensions assign. Since Python 3.12, they are among the variables of the function's code."""
    nodes = [*ast.walk(source)]
    inner = set(comprehended(nodes))
    others = {
        node.id
        for node in nodes
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node not in inner
    }
    parameters = {node.arg for node in nodes if isinstance(node, ast.arg)}
    return {node.id for node in inner} - others - parameters


def _attribute(holder: Any, name: str, default: Any) -> Any:
    return vars(holder).get(name, default) if is_namespace(holder) else _UNKNOWN


def _item(holder: Any, key: Any, default: Any) -> Any:
    return holder.get(key, default) if isinstance(holder, dict) else _UNKNOWN


def is_plain(value: Any) -> bool:
    """Whether a value is a number, text, a flag, None or a list of them."""
    if isinstance(value, (list, tuple, set, frozenset)):
        return all(is_plain(one) for one in value)
    return value is None or isinstance(value, (bool, int, float, str, range))


def is_namespace(value: Any) -> bool:
    """Whether an object, such as a namespace of options, holds values and has no public methods."""
    kind = type(value)
    return hasattr(value, "__dict__") and not any(
        callable(getattr(kind, name)) for name in dir(kind) if not name.startswith("_")
    )
