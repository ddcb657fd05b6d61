"""Names in a training loop, read from its code without running it."""

from __future__ import annotations

import ast
import dis
import inspect
import platform
import types
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from skipgs_plug.adapters.loop_bounds import function_of
from skipgs_plug.core.errors import AdapterMismatchError

LOOP = "training"  # name of the function that holds the loop, in the whole Inria family
OPTIONS = "opt"  # its variable that holds the options of optimization
RATES = "update_learning_rate"  # method of the model that each iteration calls with its number


class LoopCode(NamedTuple):
    """The names in a training script.

    Attributes:
        source: File of the script, or name of the module, for sentences.
        names: Global names of the script, and every global and attribute that its function `training` uses.
        functions: Names of its functions and classes.
        backward: Names of its functions that call `backward`, themselves or in a function inside them.
        callers: Names of the functions that call the training backward: `training`, functions inside it, or else
            functions of the script that its loop calls. Empty if the loop that sets the rates is in another function.
        used: Every global and attribute that `training` and the functions that it calls use. Empty if there is no
            function `training`.
        repeated: The subset of `used` inside the loop itself and in functions that the loop calls.
        called: Names of the functions and methods that are called there; all of `repeated` if there is no source.
        keywords: Names by which arguments are passed.
        stored: Attributes that the loop assigns to.
        variables: Variables of `training`, of functions inside it, and of functions of the script that its loop calls.
        syntax: Syntax of `training`; None if there is no source.
    """

    source: str
    names: frozenset[str]
    functions: frozenset[str]
    backward: frozenset[str] = frozenset()
    callers: frozenset[str] = frozenset()
    used: frozenset[str] = frozenset()
    repeated: frozenset[str] = frozenset()
    called: frozenset[str] = frozenset()
    keywords: frozenset[str] = frozenset()
    stored: frozenset[str] = frozenset()
    variables: frozenset[str] = frozenset()
    syntax: ast.FunctionDef | None = None

    @property
    def calls_backward(self) -> bool:
        """Whether the script itself calls `backward`, so that it has a loop of its own."""
        return bool(self.backward) or "backward" in self.names - self.functions

    def leaves_training_to(self, package: str) -> bool:
        """Whether the script uses this package, and has no training loop itself."""
        return not self.calls_backward and any(name.partition(".")[0] == package for name in self.names)

    @property
    def number(self) -> str:
        """Name of the variable that holds the iteration's number: the one that `update_learning_rate` receives."""
        for node in () if self.syntax is None else ast.walk(self.syntax):
            match node:
                case ast.Call(ast.Attribute(_, attr), [ast.Name(name), *_]) if attr == RATES:
                    return name
        return "iteration"

    @property
    def counts_with_range(self) -> bool:
        """Whether a loop over a range may set the rates; False for `while` and for loops over a data loader alone."""
        if self.syntax is None:
            return True
        around = [loop for loop in _loops(self.syntax) if RATES in _called_in(loop)]
        heads = [loop.iter for loop in around if isinstance(loop, ast.For)]
        made, grown = {"range"}, 0
        assigned = [node for node in ast.walk(self.syntax) if isinstance(node, (ast.Assign, ast.AnnAssign))]
        while grown != len(made):
            grown = len(made)
            made = made.union(*(_names_in(node, ast.Store) for node in assigned if _names_in(node, ast.Load) & made))
        return not around or any(_names_in(head, ast.Load) & made for head in heads)

    @classmethod
    def of_module(cls, namespace: Mapping[str, Any]) -> LoopCode:
        """Read an imported module."""
        source = str(namespace.get("__file__") or namespace.get("__name__"))
        functions = {
            name: value.__code__
            for name, value in namespace.items()
            if isinstance(value, types.FunctionType) and value.__globals__ is namespace
        }
        return cls._made(source, set(namespace), functions, lambda name: function_of(namespace[name], name))

    @classmethod
    def of_script(cls, path: Path) -> LoopCode:
        """Read a script that is about to run.

        Raises:
            AdapterMismatchError: It is not a Python script.
        """
        try:
            script = compile(path.read_bytes(), str(path), "exec")
        except (SyntaxError, ValueError) as error:
            raise AdapterMismatchError(
                f"{path} is not a script for Python {platform.python_version()}: {error}."
            ) from error
        parts = [const for const in script.co_consts if isinstance(const, types.CodeType)]
        functions = {part.co_name: part for part in parts if part.co_name.isidentifier()}  # "<lambda>" is none
        return cls._made(str(path), {*script.co_names, *functions}, functions, lambda name: function_of(path, name))

    @classmethod
    def _made(
        cls,
        source: str,
        own: set[str],
        functions: Mapping[str, types.CodeType],
        syntax_of: Callable[[str], ast.FunctionDef | None],
    ) -> LoopCode:
        backward = {name for name, code in functions.items() if _callers(code)}
        if LOOP not in functions:
            return cls(source, frozenset(own), frozenset(functions), frozenset(backward))
        training, syntax = functions[LOOP], syntax_of(LOOP)
        callers = _callers(training)
        if not callers:  # functions that hold a loop of their own, which sets the rates, are no helpers of this one
            called_here = _called_in(*_loops(syntax)) & backward
            callers = {name for name in called_here if RATES not in _called_in(*_loops(syntax_of(name)))}
        repeated, stored = _in_loop(training, syntax)
        called = _called(repeated, functions)
        syntaxes = [syntax_of(code.co_name) for code in called]
        parts = [part for code in (training, *called) for part in _with_inner(code)]
        # The compiler puts the names of keywords together in one constant.
        keywords = frozenset(
            word
            for part in parts
            for const in part.co_consts
            if isinstance(const, tuple) and const and all(isinstance(word, str) for word in const)
            for word in const
        )
        of_called = {name for code in called for part in _with_inner(code) for name in part.co_names}
        of_loop = {name for part in _with_inner(training) for name in part.co_names}
        return cls(
            source,
            frozenset(own | of_loop),
            frozenset(functions),
            frozenset(backward),
            frozenset(callers),
            frozenset(of_loop | of_called),
            frozenset(repeated | of_called),
            frozenset(
                repeated | of_called
                if syntax is None or None in syntaxes
                else _called_in(*_loops(syntax), *(one for one in syntaxes if one is not None))
            ),
            keywords,
            frozenset(stored),
            frozenset(name for part in parts for name in (*part.co_varnames, *part.co_cellvars)),
            syntax,
        )


def names_around(caller: types.FrameType) -> Mapping[str, Any]:
    """Return the names of the function that calls, of the functions around it up to `training`, and of the script."""
    frames = [caller]
    while frames[-1].f_code.co_name != LOOP and (outer := frames[-1].f_back) is not None:
        frames.append(outer)
    if frames[-1].f_code.co_name != LOOP:
        frames = [caller]
    return ChainMap(*(dict(frame.f_locals) for frame in frames), frames[-1].f_globals)


def asks_for_random_points(names: Mapping[str, Any]) -> bool | None:
    """Return whether the options of a loop ask for random points, as `--init_type random` of 3DGS-MCMC does.

    The answer is None if there is no such option. Only the loop's own variables count: a script has objects with the
    defaults of all options, too.
    """
    given = (getattr(names.get(name), "init_type", None) for name in ("dataset", OPTIONS, "args"))
    return next((init_type == "random" for init_type in given if init_type is not None), None)


def function_names(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the global names of a function under its decorators."""
    return inspect.unwrap(function).__globals__  # type: ignore[attr-defined]


def _called(used: set[str], functions: Mapping[str, types.CodeType]) -> list[types.CodeType]:
    """Functions of the script that these names call, directly or through other functions of the script."""
    found: dict[str, types.CodeType] = {}
    waiting = [name for name in used if name in functions and name != LOOP]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name] = functions[name]
            inner = {used for part in _with_inner(functions[name]) for used in part.co_names}
            waiting += [one for one in inner if one in functions and one != LOOP]
    return list(found.values())


def _callers(code: types.CodeType) -> set[str]:
    """Names of a function, and of the functions inside it, that call `backward`."""
    # A class that defines a method of that name stores it and calls nothing.
    return {
        part.co_name
        for part in _with_inner(code)
        if any(step.argval == "backward" and step.opname != "STORE_NAME" for step in dis.get_instructions(part))
    }


def _loops(syntax: ast.FunctionDef | None) -> list[ast.For | ast.While]:
    """The loops in a function and in the functions inside it."""
    return [] if syntax is None else [node for node in ast.walk(syntax) if isinstance(node, (ast.For, ast.While))]


def _called_in(*parts: ast.AST) -> set[str]:
    """Names of the functions and methods that these parts of a source call."""
    called = [node.func for part in parts for node in ast.walk(part) if isinstance(node, ast.Call)]
    return {
        function.id if isinstance(function, ast.Name) else function.attr
        for function in called
        if isinstance(function, (ast.Name, ast.Attribute))
    }


def _names_in(part: ast.AST, use: type[ast.expr_context]) -> set[str]:
    """Return the names that a part of a source reads (`ast.Load`) or assigns (`ast.Store`)."""
    return {node.id for node in ast.walk(part) if isinstance(node, ast.Name) and isinstance(node.ctx, use)}


def _in_loop(code: types.CodeType, syntax: ast.FunctionDef | None) -> tuple[set[str], set[str]]:
    """Names used, and attributes assigned, in the loop that calls `backward`; without one, in the whole function."""
    lines = _loop_lines(code, syntax)
    line_at = {offset: line for start, end, line in code.co_lines() for offset in range(start, end, 2)}
    inside = [step for step in dis.get_instructions(code) if not lines or line_at[step.offset] in lines]
    names = {step.argval for step in inside if isinstance(step.argval, str) and step.argval in code.co_names}
    for step in inside:  # comprehensions and inner functions
        if isinstance(step.argval, types.CodeType):
            names |= {name for part in _with_inner(step.argval) for name in part.co_names}
    return names, {step.argval for step in inside if step.opname == "STORE_ATTR"}


def _loop_lines(code: types.CodeType, syntax: ast.FunctionDef | None) -> set[int]:
    """Lines of the statements that a loop with `backward` repeats.

    They are read from the syntax: since Python 3.12, `except` and the end of `with` are compiled to jumps from behind
    the function's last statement, so jumps do not tell where a loop ends.
    """
    if syntax is None:
        return set()
    # The source of an imported function begins with line 1.
    shift = code.co_firstlineno - min([syntax.lineno, *(one.lineno for one in syntax.decorator_list)])
    lines: set[int] = set()
    for loop in ast.walk(syntax):
        if not isinstance(loop, (ast.For, ast.While)):
            continue
        if any(isinstance(node, ast.Attribute) and node.attr == "backward" for node in ast.walk(loop)):
            first = loop.test if isinstance(loop, ast.While) else loop.body[0]
            lines |= {*range(first.lineno + shift, (loop.body[-1].end_lineno or first.lineno) + shift + 1)}
    return lines


def _with_inner(code: types.CodeType) -> Iterator[types.CodeType]:
    yield code
    for const in code.co_consts:
        if isinstance(const, types.CodeType):
            yield from _with_inner(const)


def namespace_of(trainer: Any) -> dict[str, Any] | None:
    """Return the global names of a train module, or of the module of a training function."""
    if isinstance(trainer, types.ModuleType):
        return vars(trainer)
    if isinstance(trainer, types.FunctionType):
        return trainer.__globals__
    return None
