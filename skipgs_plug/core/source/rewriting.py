"""Rewrites of a loop's statements that keep their meaning: other names, repeated statements, and plainer ones."""

from __future__ import annotations

import ast
import copy
import inspect
from collections.abc import Callable, Mapping
from types import CodeType
from typing import Any

from skipgs_plug.core.source.functions import returns_owner


class _Rewrite(ast.NodeTransformer):
    """Changes statements in place."""

    def visit_all(self, body: list[ast.stmt]) -> None:
        """Change these statements."""
        body[:] = self.visit(ast.Module(body, [])).body

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return node  # names and constants are most of the nodes, and have no parts to change

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        return node


class Renamed(_Rewrite):
    """Puts expressions in place of names. Texts that are put together of constants then are one constant."""

    def __init__(self, meanings: Mapping[str, ast.expr]) -> None:
        self._meanings = meanings

    def visit_Name(self, node: ast.Name) -> ast.expr:
        meaning = self._meanings.get(node.id)
        if meaning is None:
            return node
        if isinstance(meaning, ast.Name):
            return ast.copy_location(ast.Name(meaning.id, node.ctx), node)
        return ast.copy_location(copy.deepcopy(meaning), node)

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        self.generic_visit(node)
        match node:
            case ast.Subscript(ast.Tuple(values) | ast.List(values), ast.Constant(int(index))) if index < len(values):
                return ast.copy_location(values[index], node)
        return node

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.expr:
        self.generic_visit(node)
        parts = [one.value if isinstance(one, ast.FormattedValue) else one for one in node.values]
        if any(isinstance(one, ast.FormattedValue) and one.format_spec is not None for one in node.values):
            return node
        return _text(node, parts)

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        self.generic_visit(node)
        return _text(node, [node.left, node.right]) if isinstance(node.op, ast.Add) else node


class OneName(_Rewrite):
    """Puts one name of an object in place of the others, as `run` for `self.saver.run`.

    Args:
        name: Returns the name for a name, attribute or entry; None if it stays.
    """

    def __init__(self, name: Callable[[ast.expr], str | None]) -> None:
        self._name = name

    def visit_Attribute(self, node: ast.Name | ast.Attribute) -> ast.expr:
        name = self._name(node) if isinstance(node.ctx, ast.Load) else None
        if name is None:
            return self.generic_visit(node)  # type: ignore[return-value]
        made = ast.parse(name, mode="eval").body
        for part in ast.walk(made):
            ast.copy_location(part, node)
        return made

    visit_Name = visit_Attribute


class Plain(_Rewrite):
    """Writes `locals()` and `vars()` as the dictionary that they return, and `await call` as the call.

    They are written so as arguments of calls and as values of assignments, which hand the number on. Elsewhere, as in
    `"mask" in locals()`, their values do not matter.

    Args:
        code: Code of the function that contains the statements.
    """

    def __init__(self, code: CodeType) -> None:
        local = (*code.co_varnames, *code.co_cellvars, *code.co_freevars)
        self._local = local if code.co_flags & inspect.CO_NEWLOCALS else code.co_names

    def visit_Call(self, node: ast.Call) -> ast.AST:
        node.args = [*map(self._written, node.args)]
        for keyword in node.keywords:
            keyword.value = self._written(keyword.value)
        return self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> ast.AST:
        node.value = self._written(node.value)
        return self.generic_visit(node)

    def _written(self, value: ast.expr) -> ast.expr:
        match value:
            case ast.Call(ast.Name("locals" | "vars"), [], []):
                names: list[ast.expr] = [ast.Name(name, ast.Load()) for name in self._local]
                entries = ast.Dict([ast.Constant(name) for name in self._local], names)
                return ast.fix_missing_locations(ast.copy_location(entries, value))
        return value

    def visit_Await(self, node: ast.Await) -> ast.AST:
        return self.visit(node.value)  # type: ignore[no-any-return]


class Managed(_Rewrite):
    """Adds the calls that `with Saver(step):` makes of the object's methods, around the block.

    The name after `as` is assigned in the block.

    Args:
        entered: Returns the class of the object that a `with` statement enters; None if it is unknown.
    """

    def __init__(self, entered: Callable[[ast.expr], type | None]) -> None:
        self._entered = entered

    def visit_With(self, node: ast.With) -> ast.AST:
        self.generic_visit(node)
        begin: list[ast.stmt] = []
        end: list[ast.stmt] = []
        for item in node.items:
            cls, made = self._entered(item.context_expr), item.context_expr
            if cls is None:
                continue
            enter = _call_of(made, "__enter__", 0)
            begin.append(enter)
            end.insert(0, _call_of(made, "__exit__", 3))
            if item.optional_vars is not None:
                is_same = returns_owner(inspect.getattr_static(cls, "__enter__", None))
                entered = copy.deepcopy(made if is_same else enter.value)
                begin.append(ast.copy_location(ast.Assign([item.optional_vars], entered), made))
                item.optional_vars = None
        node.body = [*begin, *node.body, *end]
        return node


class Repeated(_Rewrite):
    """Replaces a loop over known objects by its statements, once for each object, with the object's name.

    The element of a comprehension is replaced in the same way, as in `[callback(step) for callback in callbacks]`.
    """

    def __init__(self, held: Callable[[ast.For | ast.comprehension], list[ast.expr]]) -> None:
        self._held = held

    def visit_For(self, node: ast.For) -> ast.stmt | list[ast.stmt]:
        held = self._held(node) if isinstance(node.target, ast.Name) else []
        if not held:
            return self.generic_visit(node)  # type: ignore[return-value]
        name = ast.unparse(node.target)
        return [Renamed({name: one}).visit(copy.deepcopy(part)) for one in held for part in node.body]

    def visit_ListComp(self, node: ast.ListComp | ast.SetComp | ast.GeneratorExp) -> ast.AST:
        values, *further = node.generators
        plain = isinstance(values.target, ast.Name) and not values.ifs and not further
        held = self._held(values) if plain else []
        if not held:
            return self.generic_visit(node)
        name = ast.unparse(values.target)
        parts = [Renamed({name: one}).visit(copy.deepcopy(node.elt)) for one in held]
        return ast.copy_location(ast.Tuple(parts, ast.Load()), node)

    visit_SetComp = visit_GeneratorExp = visit_ListComp

    def visit_Call(self, node: ast.Call) -> ast.AST:
        match node:
            case ast.Call(ast.Name("map"), [ast.Lambda(ast.arguments([], [parameter]), element), values], []):
                value = ast.comprehension(ast.Name(parameter.arg, ast.Store()), values, [], 0)
                return self.visit_ListComp(ast.copy_location(ast.GeneratorExp(element, [value]), node))
        return self.generic_visit(node)


class Stored(_Rewrite):
    """Adds the assignments that calls make, as `state["step"] = step` after `state.update(step=step)`.

    Further such calls are `steps.append(step)`, which assigns `steps[-1]`, and `setattr(run, "step", step)`.

    Args:
        value: Returns the value of a name, attribute or entry before the loop; None if it is unknown.
    """

    def __init__(self, value: Callable[[ast.expr], Any]) -> None:
        self._value = value

    def visit_Expr(self, node: ast.Expr) -> list[ast.stmt]:
        stores: list[tuple[ast.expr, ast.expr]] = []
        match node.value:
            case ast.Call(ast.Attribute(held, "update"), [], entries) if isinstance(self._value(held), dict):
                named = ((entry.arg, entry.value) for entry in entries if entry.arg is not None)
                stores = [(ast.Subscript(held, ast.Constant(name), ast.Store()), value) for name, value in named]
            case ast.Call(ast.Attribute(held, "update"), [ast.Dict(keys, values)], []):
                pairs = [pair for pair in zip(keys, values, strict=True) if isinstance(pair[0], ast.Constant)]
                stores = [(ast.Subscript(held, key, ast.Store()), value) for key, value in pairs if key is not None]
            case ast.Call(ast.Attribute(held, "append"), [value], []) if isinstance(self._value(held), list):
                last = ast.UnaryOp(ast.USub(), ast.Constant(1))
                stores = [(ast.Subscript(held, last, ast.Store()), value)]
            case ast.Call(ast.Name("setattr"), [held, ast.Constant(str(name)), value], []):
                stores = [(ast.Attribute(held, name, ast.Store()), value)]
        added = [ast.Assign([target], copy.deepcopy(value)) for target, value in stores]
        return [node, *(ast.fix_missing_locations(ast.copy_location(one, node)) for one in added)]


def _text(node: ast.expr, parts: list[ast.expr]) -> ast.expr:
    """Return the text that these parts have together; the node itself if they are not all texts."""
    texts = [one.value for one in parts if isinstance(one, ast.Constant) and isinstance(one.value, str)]
    return ast.copy_location(ast.Constant("".join(texts)), node) if len(texts) == len(parts) else node


def _call_of(owner: ast.expr, method: str, arguments: int) -> ast.Expr:
    """Return a call of a method with so many times None."""
    nothing: list[ast.expr] = [ast.Constant(None) for _ in range(arguments)]
    call = ast.Call(ast.Attribute(copy.deepcopy(owner), method, ast.Load()), nothing, [])
    return ast.fix_missing_locations(ast.copy_location(ast.Expr(call), owner))
