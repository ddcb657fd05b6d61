"""Inlining: functions of the project that a loop calls with its number, read as if they were written in the loop."""

from __future__ import annotations

import ast
import builtins
import dis
import inspect
from collections.abc import Collection, Iterator, Mapping
from types import CodeType, FunctionType, MethodType
from typing import Any, NamedTuple

from skipgs_plug.core.source.accesses import access
from skipgs_plug.core.source.bindings import arguments, assigned_values, handed_over, initialiser, spread
from skipgs_plug.core.source.dispatch import chooses_decision, is_hidden
from skipgs_plug.core.source.functions import (
    closure,
    read_syntax,
    undecorated,
    without_partial,
)
from skipgs_plug.core.source.known_values import KnownValues
from skipgs_plug.core.source.names import PLACES, bound_in, counted_by, holders_of, reached_in
from skipgs_plug.core.source.reach import carries, reached_by, results
from skipgs_plug.core.source.rewriting import Managed, OneName, Plain, Renamed, Repeated, Stored
from skipgs_plug.core.source.run_options import PURE, assigned_globals, comprehended, text_of

# Largest depth of nested calls that are read: a loop calls its trainer, which calls a logger, which opens a file.
MAX_DEPTH = 5
_ABSENT = object()


class InlinedFunction(NamedTuple):
    """A function whose statements are read in place of a call.

    Attributes:
        body: Its statements, in the names of the loop. Parameters are replaced by the arguments, and names that the
            loop does not know get the name of the function or of its module in front.
        code: Its code.
        held: Entries and attributes of arguments that are new dictionaries, tuples or objects, as source text.
    """

    body: list[ast.stmt]
    code: CodeType
    held: dict[str, ast.expr]


class InlinedFunctions(KnownValues):
    """The functions that a loop calls with its number, or that read its number, and the functions that they call.

    Only functions of the user's own project are read, and methods of objects that exist before the loop or are made in
    it by a call of their class.

    Args:
        body: The loop's statements.
        code: Code of the function that holds the loop.
        names: Names and values before the loop. Names of the functions are added.
        target: Name of the loop's number.
        counters: Names, attributes and lengths with which the loop counts by itself. Functions that receive them are
            read too.
        unknown: Names and attributes that the loop assigns.
        pure: Names of functions that are evaluated and not read.

    Attributes:
        by_call: The functions, by the id, in the syntax tree, of the call, or of the attribute or entry that makes it.
        unknown: The argument, and variables of the functions whose values are not known before the loop.
        counted: Variables of the functions that begin with the number and are assigned again.
        shared: Added names that other functions may change.
        reached: Places that may hold the number, or a value that depends on it; see `reach`.
        unread: Calls with the number, by id in the syntax tree, of functions that are not known, or cannot be read.
    """

    def __init__(
        self,
        body: list[ast.stmt],
        code: CodeType,
        names: dict[str, Any],
        target: str,
        counters: Collection[str],
        unknown: Collection[str],
        pure: Collection[str],
    ) -> None:
        super().__init__(code, names, unknown, pure)
        self.by_call: dict[int, InlinedFunction] = {}
        self.counted, self.shared = set[str](), set[str]()
        self.reached, self.unread = {target, *counters}, set[int]()
        self._looped = set[str]()  # names that loops over known values give to these
        self._returning: set[int] = set()  # calls whose functions return what they receive or compute from it, by id
        self._target = target
        self._globals = _stored_globals(code)  # those of the loop's module that the loop or its functions assign
        self._assigned: dict[int, ast.expr] = {}  # values that are assigned, by the id of the target in the syntax tree
        self._nodes: list[ast.AST] = []  # keeps the nodes of `by_call`, so that no new node gets the id of one
        Repeated(self._held).visit_all(body)
        Managed(self._entered).visit_all(body)
        numbers = {target, *map(counted_by, counters)}
        kept = reached_by([node for statement in body for node in reached_in(statement)], numbers, ())
        self._note_shared(holders_of(kept))
        OneName(self._shared_name).visit_all(body)
        self._follow(body, numbers)

    def __iter__(self) -> Iterator[ast.stmt]:
        """Iterate over the statements of all functions."""
        return (statement for function in self.by_call.values() for statement in function.body)

    def _follow(self, body: list[ast.stmt], numbers: set[str]) -> set[str]:
        """Read the functions that statements call with the number, or that read it from the loop's variable.

        The names and attributes that hold the number afterwards are returned.

        Args:
            body: The statements.
            numbers: Names and attributes that hold the number, or a value that is computed from it.
        """
        nodes = [node for statement in body for node in reached_in(statement)]
        for node in nodes:
            for target, value in assigned_values(node):
                if isinstance(target, PLACES):
                    self._assigned[id(target)] = value
                    held = self.held_in(text_of(target), value)
                    numbers |= self._numbers_in(held, numbers)
                    self._note_new(held)
                    self.reached |= {text for text, one in held.items() if self._carries(one)}
            match node:
                case ast.For(ast.Name(name), values) if self._value(values) is not None:
                    self._looped.add(name)
        self.reached = reached_by(nodes, self.reached, self._returning)
        holders = holders_of(numbers)
        self._note_shared(holders)
        for node in nodes:
            call, function = self._called(node, numbers, holders)
            plain = undecorated(function)
            if function is None and self._is_unread(node, numbers, holders):
                self._note_unread(node)
            if call is not None and plain is not None and plain.__code__ not in self._open and self._is_own(plain):
                before = set(self.unknown)
                read = self._read(call, function, plain, numbers)
                if is_hidden(function, plain, read is not None, self._project) and self._gets(call):
                    self._note_unread(node)
                if read is not None:
                    self.by_call[id(node)] = read
                    self._nodes.append(node)
                    self._note_new(read.held)
                    self._open.append(plain.__code__)
                    self.reached |= {text for text, one in read.held.items() if self._carries(one)}
                    kept = self._follow(read.body, numbers | self._numbers_in(read.held, numbers))
                    self._open.pop()
                    if any(map(self._carries, results(read.body))):
                        self._returning.add(id(node))
                        self.reached = reached_by(nodes, self.reached, self._returning)
                    own = self.unknown - before
                    new = {text for text in kept - numbers if own.isdisjoint({text, *holders_of([text])})}
                    numbers, holders = numbers | new, holders | holders_of(new)
        return numbers

    def _numbers_in(self, held: Mapping[str, ast.expr], numbers: Collection[str]) -> set[str]:
        """Return the texts whose values are computed from the number."""
        return {text for text, value in held.items() if self._is_of(value, numbers)}

    def _called(self, node: ast.AST, numbers: Collection[str], holders: Collection[str]) -> tuple[ast.Call | None, Any]:
        """Return the call and the function if a node calls a function with the number, or reads such a property."""
        if isinstance(node, ast.Call) and self._is_read(node):
            found = self._function(node.func)
            shares = self._shares_number(undecorated(found), numbers) or self._refers_to_shared(found)
            if shares or self._receives(node, numbers, holders):
                call, found = initialiser(node, found) if inspect.isclass(found) else (node, found)
                if found is None and isinstance(call.func, ast.Attribute):
                    call, found = self._method_of_new(call, call.func)
                call, found = without_partial(call, found, self._named)
                handed = None if self._is_own(found) else handed_over(node, self._is_function)
                return (call, found) if handed is None else (handed, self._function(handed.func))
        made, method = access(node, self._assigned.get(id(node)), self._class)
        return (made, method) if made is not None and self._receives(made, numbers, holders) else (None, None)

    def _method_of_new(self, call: ast.Call, method: ast.Attribute) -> tuple[ast.Call, Any]:
        """Return a call `Saver(step).save()` with the object as first argument, and its method; None if unknown."""
        found = inspect.getattr_static(self._new(method.value), method.attr, None)
        if isinstance(found, staticmethod):
            return call, found.__func__
        if not isinstance(found, FunctionType):
            return call, None
        return ast.copy_location(ast.Call(call.func, [method.value, *call.args], call.keywords), call), found

    def _is_read(self, call: ast.Call) -> bool:
        """Whether a call has a function that is known before the loop, and is not evaluated instead."""
        return not self._is_pure(call.func) and not (isinstance(call.func, ast.Name) and call.func.id in self.unknown)

    def _is_pure(self, function: ast.expr) -> bool:
        """Whether a function is evaluated and not read, or a method is said to need no iteration."""
        match function:
            case ast.Name(name):
                return name in self._pure
            case ast.Attribute(_, name):  # it may have the name of a built-in function
                return name in self._pure and name not in PURE
        return False

    def _shares_number(self, plain: FunctionType | None, numbers: Collection[str]) -> bool:
        """Whether a function reads a variable of the loop that holds a number: a closure, or a global name."""
        loop = self._open[0]
        if plain is None:
            return False
        if not set(numbers).isdisjoint({*plain.__code__.co_freevars} & {*loop.co_cellvars}):
            return True
        written = self._globals.intersection(numbers)
        of_module = plain.__module__ == self._names.get("__name__")
        return of_module and any(
            one.opname == "LOAD_GLOBAL" and one.argval in written for one in dis.get_instructions(plain)
        )

    def _receives(self, call: ast.Call, numbers: Collection[str], holders: Collection[str]) -> bool:
        """Whether a function receives the number, or an object that holds it in an attribute."""
        call = spread(call)
        owner = call.func.value if isinstance(call.func, ast.Attribute) else call.func
        given = [*call.args, *(keyword.value for keyword in call.keywords), owner]
        if any(self._numbers_in(self.held_in("", value), numbers) for value in given):
            return True
        given = [one.value if isinstance(one, ast.Starred) else one for one in given]
        return any(
            (isinstance(one, (ast.Name, ast.Attribute)) and text_of(one) in holders) or self._carries(one)
            for one in given
        )

    def _is_unread(self, node: ast.AST, numbers: Collection[str], holders: Collection[str]) -> bool:
        """Whether this calls a function with the number that is not known before the loop, and may decide by it."""
        if not (isinstance(node, ast.Call) and self._receives(node, numbers, holders) and self._gets(node)):
            return False
        if self._is_pure(node.func):
            return False
        match node.func:
            case ast.Name(name):
                is_new = name in self.unknown or not hasattr(builtins, name)
                return is_new and not {name} & {*self._names, *self._looped, *self._made}
            case ast.Call(made) if inspect.isclass(self._function(made)):
                return False
        return chooses_decision(node.func, self._value, self._project, self._open)

    def _note_unread(self, node: ast.AST) -> None:
        self.unread.add(id(node))
        self._nodes.append(node)

    def _gets(self, call: ast.Call) -> bool:
        """Whether an argument may be the number, or hold it, or be computed from it."""
        return any(map(self._carries, [*call.args, *(one.value for one in call.keywords)]))

    def _carries(self, value: ast.expr) -> bool:
        """Whether a value may be the number, or hold it, or be computed from it in a way that is not followed."""
        held = self.held_in("", value).values()
        return any(carries(one, self.reached, self._returning) for one in (value, *held))

    def _is_of(self, value: ast.expr, numbers: Collection[str]) -> bool:
        """Whether a value is computed from the number alone, perhaps by functions of libraries."""
        places = (part for part in ast.walk(value) if isinstance(part, PLACES))
        plain = all(self._only_reads(part) or self.is_foreign(part) for part in ast.walk(value))
        return plain and any(text_of(one) in numbers for one in places)

    def _read(
        self, call: ast.Call, function: Any, plain: FunctionType, numbers: Collection[str]
    ) -> InlinedFunction | None:
        """Return a function, in names of the loop; None if it cannot be read, or lies too deep."""
        syntax = read_syntax(plain) if len(self._open) <= MAX_DEPTH else None
        if syntax is None:
            return None
        if plain.__module__ == self._names.get("__name__"):
            self._globals |= _stored_globals(plain.__code__)
        Plain(plain.__code__).visit_all(syntax.body)
        held: dict[str, ast.expr] = {}
        renamed = Renamed(self._meanings(call, function, plain, syntax, numbers, held))
        body = [renamed.visit(statement) for statement in syntax.body]
        OneName(self._shared_name).visit_all(body)
        Stored(self._value).visit_all(body)
        Repeated(self._held).visit_all(body)
        Managed(self._entered).visit_all(body)
        return InlinedFunction(body, plain.__code__, held)

    def _meanings(
        self,
        call: ast.Call,
        function: Any,
        plain: FunctionType,
        syntax: ast.FunctionDef,
        numbers: Collection[str],
        held: dict[str, ast.expr],
    ) -> dict[str, ast.expr]:
        """Return the expressions, in names of the loop, that the names in a function stand for.

        Entries and attributes of arguments that stay in names of the function are added to `held`.
        """
        times = sum(one.code.co_name == syntax.name for one in self.by_call.values())
        prefix = f"{syntax.name}{times + 1}" if times else syntax.name  # each call has local variables of its own
        given, defaults = self._given(call, function, plain, prefix)
        bound = bound_in(syntax)
        own = bound.union(inspect.signature(plain).parameters)
        inner = {node.id for node in comprehended(ast.walk(syntax))}
        found: dict[str, ast.expr] = {}
        for name in {node.id for node in ast.walk(syntax) if isinstance(node, ast.Name)}:
            if name in inner and name not in own:
                found[name] = ast.Name(f"{prefix}.{name}", ast.Load())
            elif name not in own:
                found |= self._from_outside(name, plain, prefix)
            elif name in given and name not in bound and self._is_plain(given[name]):
                found[name] = given[name]
            elif name in defaults and name not in bound:
                found[name] = self._named(f"{prefix}.{name}", defaults[name])
            else:
                found[name] = ast.Name(f"{prefix}.{name}", ast.Load())
                self.unknown.add(f"{prefix}.{name}")
                if name in given and self._carries(given[name]):
                    self.reached.add(f"{prefix}.{name}")
                if name in given and self._is_of(given[name], numbers):
                    self.counted.add(f"{prefix}.{name}")
                elif name in given and name not in bound:
                    held |= self.held_in(f"{prefix}.{name}", given[name])
        return found

    def _from_outside(self, name: str, plain: FunctionType, prefix: str) -> dict[str, ast.expr]:
        """Return the meaning of a name that a function does not assign; nothing if it means the same in the loop."""
        if name in {self._target, *self._globals} and self._shares_number(plain, {name}):
            return {}
        surrounding, loop = closure(plain), self._open[0]
        if name in surrounding:
            value, own = surrounding[name], f"{prefix}.{name}"
            same, changes = name in (*loop.co_cellvars, *loop.co_freevars), True
        elif name in plain.__globals__:
            value, own = plain.__globals__[name], f"{plain.__module__}.{name}"
            same = plain.__module__ == self._names.get("__name__")
            changes = name in assigned_globals(plain.__code__.co_filename)
        else:
            return {}  # a built-in function
        if same and name != self._target and self._names.get(name, _ABSENT) is value:
            return {}
        if changes:
            self.shared.add(own)
        return {name: self._named(own, value)}

    def _given(
        self, call: ast.Call, function: Any, plain: FunctionType, prefix: str
    ) -> tuple[dict[str, ast.expr], dict[str, Any]]:
        """Return the arguments of a call, and the default values of further parameters if no argument is hidden."""
        call, signature = spread(call), inspect.signature(plain)
        if isinstance(function, MethodType):
            owner = call.func.value if isinstance(call.func, ast.Attribute) else call.func
            # super().name(...), or a name of the bound method
            if not self._is_plain(owner) or self._value(owner) is not function.__self__:
                own = self._names.get("self") is function.__self__
                owner = ast.Name("self", ast.Load()) if own else self._named(f"{prefix}.self", function.__self__)
            call = ast.copy_location(ast.Call(call.func, [owner, *call.args], call.keywords), call)
        given = arguments(call, signature)
        hidden = any(isinstance(value, ast.Starred) for value in call.args)
        if hidden or any(keyword.arg is None for keyword in call.keywords):
            return given, {}
        absent = (one for name, one in signature.parameters.items() if name not in given)
        return given, {one.name: one.default for one in absent if one.default is not one.empty}


def _stored_globals(code: CodeType) -> set[str]:
    """Return the global names that a function, or the code of a module, assigns."""
    stores = "STORE_GLOBAL" if code.co_flags & inspect.CO_NEWLOCALS else "STORE_NAME"
    return {one.argval for one in dis.get_instructions(code) if one.opname == stores}
