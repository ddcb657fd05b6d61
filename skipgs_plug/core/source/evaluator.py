"""Evaluates conditions of a loop for iterations that the loop has not reached."""

from __future__ import annotations

import ast
import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping
from types import CodeType
from typing import Any

import numpy as np
import numpy.typing as npt

from skipgs_plug.core.source.conditions import Guards, is_point, leaves
from skipgs_plug.core.source.names import PLACES
from skipgs_plug.core.source.run_options import RunOptions, comprehended, text_of

Truths = npt.NDArray[np.bool_]  # one truth value for each number of a range
_NUMBERS = "numbers of the loop"  # with spaces, so that no name in a source is the same


class DependsOnLoop(Exception):
    """A condition on the number depends on values that the loop changes."""


class Evaluator:
    """Evaluates conditions for any number, and tells which expressions can be evaluated before the loop.

    Args:
        target: Name of the loop's number.
        counted: Other names that hold the number, and that the loop changes.
        names: Names and values before the loop.
        changing: Names and attributes that the loop assigns or changes.
        options: Recognises the options of the run.

    Attributes:
        target, names: The arguments.
    """

    def __init__(
        self,
        target: str,
        counted: Collection[str],
        names: Mapping[str, Any],
        changing: Collection[str],
        options: RunOptions,
    ) -> None:
        self.target, self.names = target, names
        self._numbers = {target, *counted}
        self._changing, self._options = changing, options

    def is_known(self, node: ast.expr) -> bool:
        """Whether the values of an expression in all iterations are known before the loop."""
        if self.mentions(node):
            return not self.depends_on_loop(node)
        return node in self._options or self._options.keeps_value(node)

    def mentions(self, node: ast.AST) -> bool:
        """Whether the number occurs in this part of the source."""
        return any(isinstance(part, ast.Name) and part.id in self._numbers for part in ast.walk(node))

    def depends_on_loop(self, node: ast.expr) -> bool:
        """Whether an expression depends on the number and on values that the loop changes."""
        return self.mentions(node) and not self.is_of_number(node)

    def is_of_number(self, node: ast.expr, is_foreign: Callable[[ast.Call], bool] = lambda call: False) -> bool:
        """Whether an expression is computed from the number, and from values that the loop does not change.

        Args:
            node: The expression.
            is_foreign: Whether a call may be part of it although it cannot be evaluated ahead.
        """
        if not self.mentions(node):
            return False
        parts = list(ast.walk(node))
        read = places_in(node) - {name.id for name in comprehended(parts)}
        calls = [part for part in parts if isinstance(part, ast.Call)]
        return read.isdisjoint(self._changing) and all(
            self._options.only_reads(one) or is_foreign(one) for one in calls
        )

    def value(self, node: ast.expr) -> Any:
        """Return the value that a name, attribute or entry has in all iterations; None if it is not known."""
        parts = [part for part in ast.walk(node) if isinstance(part, ast.expr)]
        reads = all(isinstance(part, (*PLACES, ast.Constant)) for part in parts)
        if reads and places_in(node).isdisjoint(self._changing) and not self.mentions(node):
            with contextlib.suppress(Exception):
                return eval(_compiled(node), dict(self.names))
        return None

    def is_option(self, node: ast.expr) -> bool:
        """Whether an expression consists of options of the run."""
        return node in self._options

    def is_off(self, test: ast.expr) -> bool:
        """Whether a condition never holds because an option is off."""
        parts = test.values if isinstance(test, ast.BoolOp) and isinstance(test.op, ast.And) else [test]
        return any(self.is_option(part) and not eval(_compiled(part), dict(self.names)) for part in parts)

    def branches(self, numbers: range, test: ast.expr, guards: Guards) -> Iterator[tuple[set[int], set[int]]]:
        """Yield two sets: the numbers that reach a condition and for which it holds, and for which it does not hold.

        Parts of the condition that do not depend on the number are assumed to be true for the first pair of sets, and
        false for the second pair.

        Raises:
            DependsOnLoop: The condition depends on a value that the loop changes.
        """
        return _Evaluation(self, test, guards, numbers).branches()


class _Evaluation:
    """Evaluates one condition, and the guards in front of it, for all numbers at once."""

    def __init__(self, evaluator: Evaluator, test: ast.expr, guards: Guards, numbers: range) -> None:
        self._evaluator, self._test, self._guards, self._numbers = evaluator, test, guards, numbers

    def branches(self) -> Iterator[tuple[set[int], set[int]]]:
        reached = np.ones(len(self._numbers), dtype=bool)
        for guard in self._guards:
            reached = self._holds(guard, reached, True)
        numbers = np.array(self._numbers)
        for assumed in (True, False):
            holds = self._holds(self._test, reached, assumed)
            yield set(numbers[holds].tolist()), set(numbers[reached & ~holds].tolist())

    def _holds(self, node: ast.expr, reached: Truths, assumed: bool) -> Truths:
        """Return for which of the numbers that reach a part of a condition the part holds."""
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return reached & ~self._holds(node.operand, reached, not assumed)
        if isinstance(node, ast.BoolOp):
            is_and = isinstance(node.op, ast.And)
            undecided = reached
            for part in sorted(node.values, key=self._depends_on_loop):  # other parts may decide alone
                holds = self._holds(part, undecided, assumed)
                undecided = holds if is_and else undecided & ~holds
            return undecided if is_and else reached & ~undecided
        if self._evaluator.depends_on_loop(node):
            if reached.any() and is_point(node) and any(leaf is node for leaf in leaves(self._test)):
                raise DependsOnLoop
        elif self._evaluator.mentions(node) or self._evaluator.is_option(node):
            return reached & self._values(node, assumed)
        return reached & assumed

    def _depends_on_loop(self, part: ast.expr) -> bool:
        return any(self._evaluator.depends_on_loop(leaf) for leaf in leaves(part))

    def _values(self, node: ast.expr, assumed: bool) -> Truths:
        """Return the truth of a part for all numbers; `assumed` where an error shows that it is not known yet."""
        names, target = dict(self._evaluator.names), self._evaluator.target
        names[_NUMBERS] = self._numbers
        each = ast.comprehension(ast.Name(target, ast.Store()), ast.Name(_NUMBERS, ast.Load()), [], 0)
        truth = ast.UnaryOp(ast.Not(), ast.UnaryOp(ast.Not(), node))
        with contextlib.suppress(Exception):  # a name is not bound yet, or a number has another type
            return np.array(eval(_compiled(ast.ListComp(truth, [each])), names), dtype=bool)
        code, found = _compiled(node), np.full(len(self._numbers), assumed)
        for index, names[target] in enumerate(self._numbers):
            with contextlib.suppress(Exception):
                found[index] = bool(eval(code, names))
        return found


def places_in(expression: ast.expr) -> set[str]:
    """Return the names, attributes and entries that an expression reads, as source text."""
    return {text_of(part) for part in ast.walk(expression) if isinstance(part, PLACES)}


def _compiled(node: ast.expr) -> CodeType:
    return compile(ast.fix_missing_locations(ast.Expression(node)), "<condition>", "eval")
