"""Replaces names in a loop, and calls of functions without effects, by the expressions that they stand for."""

from __future__ import annotations

import ast
import copy
from collections.abc import Mapping, Sequence

from skipgs_plug.core.source.bindings import assigned_values
from skipgs_plug.core.source.evaluator import Evaluator
from skipgs_plug.core.source.inlining import InlinedFunctions
from skipgs_plug.core.source.names import PLACES
from skipgs_plug.core.source.run_options import text_of


class Substitution(ast.NodeTransformer):
    """Replaces names and calls in statements by expressions of the number and of options. It changes the statements.

    Examples are `index = step % len(views)`, and `is_due(step)` for a function that returns `step % 100 == 0`. A name
    is replaced after its assignment only. Before the assignment, its value is the previous iteration's.

    Args:
        functions: Inlined functions. Their statements are changed too.
        evaluator: Tells which expressions have values that are known before the loop.
        times: How often the loop and the functions assign each name, attribute and entry.
    """

    def __init__(
        self,
        functions: InlinedFunctions,
        evaluator: Evaluator,
        times: Mapping[str, int],
    ) -> None:
        self._functions, self._evaluator, self._times = functions, evaluator, times
        self._meanings: dict[str, ast.expr] = {}

    def apply(self, body: Sequence[ast.stmt]) -> None:
        """Replace names and calls in these statements."""
        for statement in body:
            if isinstance(statement, (ast.With, ast.AsyncWith)):
                for item in statement.items:
                    self.visit(item)
                self.apply(statement.body)
                continue
            self.visit(statement)
            for target, value in assigned_values(statement):
                name = text_of(target)
                if isinstance(target, PLACES) and self._times.get(name) == 1:
                    entry = isinstance(value, ast.Subscript)  # of a tuple that is unpacked
                    self._learn(self._functions.held_in(name, self.visit(value) if entry else value))

    def _learn(self, held: Mapping[str, ast.expr]) -> None:
        """Note the values that names, attributes and entries have from now on.

        They are values that are known before the loop, and values that functions of libraries compute from the number.
        """
        for text, value in held.items():
            if self._evaluator.is_known(value) or self._evaluator.is_of_number(value, self._functions.is_foreign):
                self._meanings[text] = value

    def visit_Name(self, node: ast.Name | ast.Attribute | ast.Subscript) -> ast.AST:
        meaning = self._meanings.get(text_of(node)) if isinstance(node.ctx, ast.Load) else None
        return self._result(node) if meaning is None else ast.copy_location(copy.deepcopy(meaning), node)

    visit_Attribute = visit_Subscript = visit_Name

    def visit_NamedExpr(self, node: ast.NamedExpr) -> ast.AST:
        self.generic_visit(node)
        name, value = node.target.id, node.value
        if not (self._times.get(name) == 1 and self._evaluator.is_known(value)):
            return node
        self._meanings[name] = value
        return value

    def visit_Call(self, node: ast.Call) -> ast.AST:
        match node:
            case ast.Call(ast.Attribute(table, "get"), [ast.Constant(key), *_]):
                meaning = self._meanings.get(f"{text_of(table)}[{key!r}]")
                if meaning is not None:
                    return ast.copy_location(copy.deepcopy(meaning), node)
        return self._result(node)

    def _result(self, node: ast.expr) -> ast.AST:
        """Return the value that a call or a property has, as an expression; the node itself if it has none."""
        self.generic_visit(node)
        function = self._functions.by_call.get(id(node))
        if function is None:
            return node
        self._learn({text: self.visit(copy.deepcopy(one)) for text, one in function.held.items()})
        self.apply(function.body)
        value = returned(function.body)
        if value is None or not (self._evaluator.mentions(value) and self._evaluator.is_known(value)):
            return node
        for part in ast.walk(value):
            ast.copy_location(part, node)
        return value


def returned(body: Sequence[ast.stmt]) -> ast.expr | None:
    """Return the value of a function as one expression; None if the function does more than that."""
    for index, statement in enumerate(body):
        match statement:
            case ast.Return(value):
                return value or ast.copy_location(ast.Constant(None), statement)
            case ast.If(test, inside, otherwise) if not any(map(_assigns, [*inside, *otherwise])):
                rest = body[index + 1 :]
                holds = returned([*inside, *rest])
                fails = None if holds is None else returned([*otherwise, *rest])
                if holds is None or fails is None:
                    return None
                return ast.copy_location(ast.IfExp(test, holds, fails), test)
            case ast.Expr(ast.Constant()) | ast.Assign([ast.Name()]) | ast.AnnAssign(ast.Name()):
                continue  # a docstring, or a variable that is replaced below
            case _:
                return None
    return ast.copy_location(ast.Constant(None), body[0]) if body else None


def _assigns(statement: ast.stmt) -> bool:
    return isinstance(statement, (ast.Assign, ast.AnnAssign))
