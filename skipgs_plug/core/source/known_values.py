"""Values, classes and functions that expressions in a loop, and in the functions that it calls, are known to have."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Collection, Iterable, Mapping
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

from skipgs_plug.core.source.bindings import held_in
from skipgs_plug.core.source.conversions import is_conversion
from skipgs_plug.core.source.functions import callbacks, called_function, closure, undecorated, value_of
from skipgs_plug.core.source.names import PLACES
from skipgs_plug.core.source.project import Project
from skipgs_plug.core.source.run_options import text_of

# Syntax that changes nothing and may be evaluated several times.
_READS = (
    *(*PLACES, ast.BinOp, ast.BoolOp, ast.Compare, ast.Constant, ast.List, ast.Tuple, ast.UnaryOp),
    *(ast.FormattedValue, ast.JoinedStr, ast.keyword),
    *(ast.boolop, ast.cmpop, ast.expr_context, ast.operator, ast.unaryop),
)


class KnownValues:
    """Looks up values, classes and functions by the expressions that name them in a loop's source.

    Args:
        code: Code of the function that holds the loop.
        names: Names and values before the loop. Further names are added.
        unknown: Names and attributes that the loop assigns.
        pure: Names of functions that are evaluated and not read.

    Attributes:
        unknown: Names and attributes whose values are not known before the loop.
    """

    def __init__(self, code: CodeType, names: dict[str, Any], unknown: Collection[str], pure: Collection[str]) -> None:
        self.unknown = set(unknown)
        self._names, self._pure = names, pure
        self._project = Project(code, names)
        self._open = [code]  # code of the loop and of the functions that are being read, outermost first
        self._made: dict[str, type] = {}  # classes of new objects, by the names that hold them
        self._shared_objects: dict[int, str] = {}  # names of known objects that hold the number, by id

    def _function(self, named: ast.expr) -> Any:
        return called_function(named, self._names, self._value, self._open[-1])

    def _note_new(self, held: Mapping[str, ast.expr]) -> None:
        """Note the names that hold new objects."""
        self._made |= {text: cls for text, value in held.items() if (cls := self._new(value)) is not None}

    def _new(self, value: ast.expr) -> type | None:
        """Return the class of a new object; None for any other value."""
        if (cls := self._made.get(text_of(value))) is not None:
            return cls
        made = self._function(value.func) if isinstance(value, ast.Call) else None
        return made if inspect.isclass(made) else None

    def _entered(self, value: ast.expr) -> type | None:
        """Return the class of an object that a `with` statement enters; None if it is unknown, or one of a library."""
        known = type(self._value(value))
        return self._new(value) or (known if self._is_own(inspect.getattr_static(known, "__enter__", None)) else None)

    def _class(self, value: ast.expr) -> type:
        """Return the class of an object; that of None if it is unknown."""
        return self._new(value) or type(self._value(value))

    def _is_own(self, function: Any) -> bool:
        """Whether this is a function of the project."""
        plain = undecorated(function)
        return plain is not None and plain in self._project

    def _is_function(self, argument: ast.expr) -> bool:
        """Whether an argument is a function of the project. An object that can be called, as a model, is none."""
        function = self._function(argument)
        return self._is_own(function) and function.__name__ != "__call__"

    def _held(self, loop: ast.For | ast.comprehension) -> list[ast.expr]:
        """Return names for the functions or objects that a loop runs over, such as callbacks; empty if unknown."""
        held, place = callbacks(self._value(loop.iter)), ast.unparse(loop.iter)
        return [self._named(f"{place}[{index}]", one) for index, one in enumerate(held)]

    def is_foreign(self, part: ast.AST) -> bool:
        """Whether a part of an expression calls a library's function, which is no method."""
        function = self._function(part.func) if isinstance(part, ast.Call) else None
        return isinstance(function, (FunctionType, BuiltinFunctionType)) and not self._is_own(function)

    def _is_plain(self, value: ast.expr) -> bool:
        """Whether an expression only reads names, attributes and entries, so that it can stand in several places."""
        return all(map(self._only_reads, ast.walk(value)))

    def _only_reads(self, part: ast.AST) -> bool:
        """Whether a part of an expression, apart from the parts inside it, changes nothing."""
        match part:
            case ast.Call(ast.Name(name), _, keywords) if name in self._pure:
                return not keywords
            case ast.Call():
                return is_conversion(part, self._function)
        return isinstance(part, _READS)

    def _value(self, place: ast.expr) -> Any:
        return value_of(place, self._names, self.unknown)

    def _named(self, name: str, value: Any) -> ast.expr:
        self._names[name] = value
        return ast.Name(name, ast.Load())

    def held_in(self, name: str, value: ast.expr) -> dict[str, ast.expr]:
        """Return the values that a name holds, as source text; see `bindings.held_in`."""
        return held_in(name, value, lambda call: self._function(call.func))

    def _note_shared(self, holders: Iterable[str]) -> None:
        """Note the known objects and tables that hold the number, so that they have one name wherever they occur."""
        for text in sorted(holders):
            found = self._value(ast.parse(text, mode="eval").body)
            held = isinstance(found, (dict, list)) or hasattr(found, "__dict__")
            if held and not isinstance(found, (ModuleType, FunctionType)):
                self._shared_objects.setdefault(id(found), text)

    def _shared_name(self, place: ast.expr) -> str | None:
        """Return the one name of an object that holds the number; None for any other value."""
        return self._shared_objects.get(id(self._value(place))) if self._shared_objects else None

    def _refers_to_shared(self, function: Any) -> bool:
        """Whether a function reads an object that holds the number: as a global name, or by its own object."""
        plain = undecorated(function)
        if plain is None or not self._shared_objects:
            return False
        owner = function.__self__ if isinstance(function, MethodType) else None
        read = [*closure(plain).values(), *map(plain.__globals__.get, plain.__code__.co_names)]
        inside = vars(owner).values() if hasattr(owner, "__dict__") else ()
        return any(id(one) in self._shared_objects for one in (owner, *read, *inside))
