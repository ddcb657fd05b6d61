"""Parts of a loop's conditions whose value is known before the loop begins and stays the same in it."""

from __future__ import annotations

import ast
import types
from collections.abc import Collection, Mapping
from typing import Any


class Settled:
    """Recognises the options of a run: names that a function has before its loop and that the loop does not assign.

    Only plain values count (numbers, text, flags, None and lists of them), in variables of the function itself or in
    objects without methods, such as a namespace of options. Methods of other objects, such as a model, may change them.

    Args:
        code: Code of the function that holds the loop.
        source: Syntax tree of the function, or of the whole module for a loop at module level.
        names: Names and values that the function has before the loop.
        changing: Names and attributes that the loop assigns or changes.
        pure: Names of functions that only read their arguments.
    """

    def __init__(
        self,
        code: types.CodeType,
        source: ast.AST,
        names: Mapping[str, Any],
        changing: Collection[str],
        pure: Collection[str],
    ) -> None:
        own = {*code.co_varnames, *code.co_cellvars} if code.co_varnames or code.co_cellvars else set(code.co_names)
        shared = (node.names for node in ast.walk(source) if isinstance(node, (ast.Global, ast.Nonlocal)))
        self._own = own.difference(*shared)  # other functions may change shared names
        self._names, self._changing, self._pure = names, changing, pure

    def __contains__(self, node: object) -> bool:
        """Whether an expression consists of options, constants and pure functions only."""
        if isinstance(node, ast.Constant):
            return True
        if isinstance(node, (ast.Name, ast.Attribute)):
            found, value = self._look_up(node)
            return found and is_plain(value)
        if isinstance(node, ast.Call):
            pure = isinstance(node.func, ast.Name) and node.func.id in self._pure and not node.keywords
            return pure and all(argument in self for argument in node.args)
        if isinstance(node, (ast.BoolOp, ast.BinOp, ast.UnaryOp, ast.Compare, ast.Tuple, ast.List, ast.Set)):
            return all(part in self for part in ast.iter_child_nodes(node) if isinstance(part, ast.expr))
        return False

    def _look_up(self, node: ast.expr) -> tuple[bool, Any]:
        """Return whether a name or an attribute is a known option, and its value."""
        if ast.unparse(node) in self._changing:
            return False, None
        if isinstance(node, ast.Name):
            return node.id in self._own and node.id in self._names, self._names.get(node.id)
        if isinstance(node, ast.Attribute):
            found, holder = self._look_up(node.value)
            if found and only_holds(holder) and node.attr in vars(holder):
                return True, vars(holder)[node.attr]
        return False, None


def is_plain(value: Any) -> bool:
    """Whether a value is a number, text, a flag, None or a list of them."""
    if isinstance(value, (list, tuple, set, frozenset)):
        return all(is_plain(one) for one in value)
    return value is None or isinstance(value, (bool, int, float, str, range))


def only_holds(value: Any) -> bool:
    """Whether an object, such as a namespace of options, holds values and has no public methods."""
    kind = type(value)
    return hasattr(value, "__dict__") and not any(
        callable(getattr(kind, name)) for name in dir(kind) if not name.startswith("_")
    )
