"""Iterations that must run, found in the loop's conditions on the iteration's number.

A training loop saves, evaluates, prunes and reports by number: `if iteration % 1000 == 0`, `if iteration in
saving_iterations`. This module finds such conditions in the source of the loop and of the functions that it calls with
the number, and evaluates them ahead of time. It does not change the source.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from numbers import Integral
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.source.assignments import Assignments, assignments_in
from skipgs_plug.core.source.bindings import assigned_values
from skipgs_plug.core.source.conditions import (
    Condition,
    conditions_in,
    is_inside,
    is_point,
    leaves,
    position,
    unconditional,
)
from skipgs_plug.core.source.counters import counters, counts_in, only_gathers
from skipgs_plug.core.source.evaluator import DependsOnLoop, Evaluator, places_in
from skipgs_plug.core.source.functions import value_of
from skipgs_plug.core.source.inlining import InlinedFunction, InlinedFunctions
from skipgs_plug.core.source.lines import line_in_file
from skipgs_plug.core.source.own_counts import decisions_by_count
from skipgs_plug.core.source.progress_bars import Moves, moves, outermost_bar_ifs
from skipgs_plug.core.source.project import Project
from skipgs_plug.core.source.reach import carries, compared, inner_values, is_kept_in, remainders
from skipgs_plug.core.source.rewriting import Plain, Stored
from skipgs_plug.core.source.run_options import PURE, RunOptions, is_plain, root_of
from skipgs_plug.core.source.substitution import Substitution

BY_ALWAYS = "name the iterations that must run (--always, always=)"


class TrainingLoop:
    """One `for` statement of a function, whose target is the iteration's number.

    Args:
        statement: The loop. Its syntax tree is changed.
        around: Syntax tree of the function or module that contains the loop.
        code: Code of that function or module.
        names: Names and values before the loop, and the values in `known`.
        known: Names that the loop assigns and whose values are known before the loop.
        pure: Names of functions that only read numbers.
    """

    def __init__(
        self,
        statement: ast.For,
        around: ast.AST,
        code: CodeType,
        names: Mapping[str, Any],
        known: Iterable[str],
        pure: frozenset[str],
    ) -> None:
        assert isinstance(statement.target, ast.Name)
        self._code, self._body, self._names = code, statement.body, dict(names)
        self._target = target = statement.target.id
        Plain(code).visit_all(statement.body)
        Stored(lambda place: value_of(place, self._names, ())).visit_all(statement.body)
        every, project = assignments_in(statement.body).possible(self._names), Project(code, self._names)
        self._counters, back = counters(statement.body, self._names, every.assigned, project)
        self._gathers = {position(one.test) for one in back if only_gathers(one)}
        self._sets_back = {position(one.test) for one in back}
        functions = InlinedFunctions(
            statement.body,
            code,
            self._names,
            target,
            self._counters,
            set(every.assigned).difference(known),
            pure | PURE,
        )
        by_functions = functions.unknown.difference(every.assigned)

        def evaluators(own: Assignments, inlined: Assignments) -> Iterator[Evaluator]:
            """Yield the evaluator, and one for which functions change no value."""
            changing = own.changed.union(by_functions, inlined.changed).difference(known)
            no_options = changing.union({target}, own.options, inlined.options)
            options = RunOptions(code, around, self._names, no_options, functions.shared, pure | PURE)
            yield Evaluator(target, functions.counted, self._names, changing, options)
            yield Evaluator(target, (), self._names, own.changed.difference(known), options)

        # What stands behind an option that is off changes nothing.
        is_off = next(evaluators(every, assignments_in(functions).possible(self._names))).is_off
        own, inlined = (assignments_in(one, is_off).possible(self._names) for one in (statement.body, functions))
        self._evaluator, self._evaluator_of_loop = evaluators(own, inlined)
        counted = decisions_by_count(self._body, self._names, project)
        self._decisions_by_count = [Condition(test, (), InlinedFunction([], one, {})) for test, one in counted]
        self._inner = set(inner_values(statement.body))
        self._bar_ifs = outermost_bar_ifs(statement.body, names, around)
        times = Counter([*own.assigned, *inlined.assigned])
        Substitution(functions, self._evaluator, times).apply(self._body)
        found = list(conditions_in(self._body, functions.by_call, unread=functions.unread))
        self._all = [one for one in found if id(one.test) not in functions.unread]
        self._unread_calls = [one for one in found if id(one.test) in functions.unread]
        self._by_call, self._reached = functions.by_call, functions.reached
        self._warned_of: set[str] = set()  # conditions that warnings have named

    def milestones(self, numbers: range, others_named: bool = False) -> dict[str, set[int]]:
        """Return the iterations that must run, by the condition that names them.

        Args:
            numbers: Iterations that may be left out.
            others_named: Whether the user has named the iterations of conditions that cannot be evaluated ahead. No
                error or warning is about such a condition then.

        Returns:
            Sets of iterations by "line N: condition", or by "line N: list" for a list of iterations that the loop
            passes to a function together with the number. A dictionary that is looked up by the number is a condition
            `number in dictionary`. The set of a condition that holds for no number is empty. Conditions that only
            advance a progress bar are not included; see `bar_moves`.

        Warns:
            RuntimeWarning: A condition depends on a counter of the loop's own, or compares the number with a limit that
                it moves, so it holds less often if iterations are left out; or a module, queue or generator receives
                the number; or a condition cannot be evaluated ahead because of a function that the loop calls.

        Raises:
            SkipGSError: A condition cannot be evaluated ahead because of the loop itself.
        """
        self._warn_of(
            self._counted_by_itself(),
            "counts the iterations that run, so it holds less often if others are left out. "
            f"Decide by {self._target} if that matters.",
        )
        found: dict[str, set[int]] = {}

        def add(condition: Condition, hits: set[int] | None) -> bool:
            if hits is not None:
                found.setdefault(f"{self._where(condition)}: {ast.unparse(condition.test)}", set()).update(hits)
            return hits is not None

        own = [one for one in self._conditions() if self._bar_if_of(one) is None]
        doubtful = [one for one in own if not add(one, _rarer(self._evaluator, one, numbers))]
        run_anyway = set().union(*found.values())
        doubtful = [one for one in doubtful if not self._reached_in(one, numbers) <= run_anyway]
        for condition in doubtful:
            add(condition, self._named_by_loop(condition, numbers, others_named))
        uncertain = [f"line {self._location(one)}" for one in doubtful]
        if not others_named:
            self._warn_of(
                self._moving_limits(),
                f"moves its own limit, so it can hold later and less often if iterations are left out; {BY_ALWAYS}.",
            )
            self._warn_of(
                self._lost(),
                "can depend on the iteration's number, or on how many iterations have run, in a way that is not read, "
                f"so iterations that it needs could be left out; {BY_ALWAYS}.",
            )
            self._warn_of(
                self._unread(),
                "hands the iteration's number to a function that is not known before the loop or lies too deep, so its "
                f"conditions are not read; {BY_ALWAYS}.",
            )
            self._warn_of(
                self._kept_for_others(),
                f"keeps the iteration's number for other code, whose conditions on it are not read; {BY_ALWAYS}.",
            )
        for lookup in self._lookups():
            hits = _rarer(self._evaluator, lookup, numbers)
            if hits:
                found[f"{self._where(lookup)}: {ast.unparse(lookup.test)}"] = hits
        uncertain = [] if others_named else self._without_warning(uncertain)
        if uncertain:
            caution(
                "Conditions on the iteration's number depend on functions that the loop calls and cannot be evaluated "
                f"ahead, so iterations that they need could be left out: {', '.join(uncertain)}; {BY_ALWAYS}."
            )
        for node in self._lists():
            try:
                value = eval(compile(ast.Expression(node), "<list>", "eval"), dict(self._names))
            except Exception:
                continue
            if _is_list(value) and (hits := {int(entry) for entry in value if entry in numbers}):
                found[f"line {line_in_file(node, self._code)}: {ast.unparse(node)}"] = hits
        return found

    def bar_moves(self, numbers: range) -> list[Moves]:
        """Return how the loop advances progress bars by hand, in iterations that need not run for them."""
        found = [Moves(bar, by, numbers) for bar, by in moves(list(unconditional(self._body)), self._names)]
        for condition in self._conditions():
            bar_if = self._bar_if_of(condition)
            if bar_if is not None and position(condition.test) == position(bar_if.test):
                hits = self._only_numbers(condition, numbers)
                if hits is not None:
                    found += [Moves(bar, by, frozenset(hits)) for bar, by in moves(bar_if.body, self._names)]
        return found

    def _reached_in(self, condition: Condition, numbers: range) -> set[int]:
        """Return the iterations in which the loop may evaluate a condition, as far as the conditions around it tell."""
        (reached, _), _ = self._evaluator.branches(numbers, ast.Constant(True), condition.guards)
        return reached

    def _named_by_loop(self, condition: Condition, numbers: range, others_named: bool) -> set[int] | None:
        """Return the iterations that a condition names if functions do not change its values; None if not known.

        Raises:
            SkipGSError: The loop itself changes a value in its condition, and the user has not named its iterations.
        """
        if condition.function is not None:
            return None
        hits = _rarer(self._evaluator_of_loop, condition, numbers)
        if hits is None and not others_named:
            text, line = ast.unparse(condition.test), line_in_file(condition.test, self._code)
            sentence = (
                f"Line {line} of {self._code.co_filename} has a condition on the iteration's number that cannot be "
                f"evaluated ahead ({text}), so an iteration that it needs could be left out; use the gate without a "
                "share, or name the iterations that must run"
            )
            raise SkipGSError(f"{sentence} (always=).", in_script=f"{sentence} (--always).")
        return hits

    def _only_numbers(self, condition: Condition, numbers: range) -> set[int] | None:
        """Return the numbers for which a condition holds; None if it also depends on other values."""
        try:
            (first, _), (second, _) = self._evaluator.branches(numbers, condition.test, condition.guards)
        except DependsOnLoop:
            return None
        return first if first == second else None

    def _conditions(self) -> Iterator[Condition]:
        """Yield all conditions that hold for single numbers, not for a range of numbers."""
        mentions = self._evaluator.mentions
        for condition in self._all:
            if mentions(condition.test) and any(is_point(leaf) and mentions(leaf) for leaf in leaves(condition.test)):
                yield condition

    def _counted_by_itself(self) -> Iterator[Condition]:
        """Yield all conditions on a counter of the loop's own, or of a function, which misses left-out iterations."""
        lines: set[str] = set()
        for condition in self._all:
            place = position(condition.test) if condition.function is None else None
            if place in self._gathers or any(self._evaluator.is_off(guard) for guard in condition.guards):
                continue
            for leaf in leaves(condition.test):
                # A limit at which a counter begins anew picks single numbers, too.
                picks = isinstance(leaf, (ast.Compare, ast.BinOp)) and (is_point(leaf) or place in self._sets_back)
                if picks and counts_in(leaf) & self._counters and not self._evaluator.mentions(leaf):
                    lines.add(self._where(condition))
                    yield condition._replace(test=leaf)
        yield from (one for one in self._decisions_by_count if self._where(one) not in lines)

    def _moving_limits(self) -> Iterator[Condition]:
        """Yield all comparisons as in `if step >= next_save: next_save += 100`."""
        for function, node in self._nodes():
            if not isinstance(node, (ast.If, ast.While)):
                continue
            moved = assignments_in(node.body).changed
            for leaf in leaves(node.test):
                if isinstance(leaf, ast.Compare) and self._evaluator.mentions(leaf) and not is_point(leaf):
                    yield from [Condition(leaf, (), function)] if places_in(leaf) & moved else []

    def _kept_for_others(self) -> Iterator[Condition]:
        """Yield all places in modules that hold the number, as `os.environ["STEP"]`, and calls as `queue.put(step)`."""
        for function, node in self._nodes():
            for target, value in assigned_values(node):
                holder = value_of(root_of(target), self._names, ())
                if isinstance(holder, ModuleType) and self._evaluator.mentions(value):
                    yield Condition(target, (), function)
            match node:  # methods of queues, pipes and generators
                case ast.Call(ast.Attribute(held, "put" | "put_nowait" | "send"), [value, *_]):
                    known = value_of(held, self._names, ()) is not None and id(node) not in self._by_call
                    yield from [Condition(node, (), function)] if known and self._evaluator.mentions(value) else []

    def _lost(self) -> Iterator[Condition]:
        """Yield all conditions on values that may depend on the number, in a way that was not followed."""
        for condition in self._all:
            if self._bar_if_of(condition) is None and not any(map(self._evaluator.is_off, condition.guards)):
                for leaf in leaves(condition.test):
                    if not self._evaluator.mentions(leaf) and not counts_in(leaf) & self._counters:
                        lost = self._may_decide(leaf, condition.function)
                        yield from [condition._replace(test=leaf)] if lost else []

    def _may_decide(self, leaf: ast.expr, function: InlinedFunction | None) -> bool:
        """Whether a condition is one on a remainder or a single value of what may depend on the number.

        In the loop itself, that is every remainder of a value that it changes.
        """
        for number in remainders(leaf):
            new = function is None and not self._evaluator.is_known(number) and not places_in(number) & self._inner
            if new or carries(number, self._reached):
                return True
        return any(is_kept_in(value, self._reached) for value in compared(leaf))

    def _unread(self) -> Iterator[Condition]:
        """Yield all calls with the number of functions that are not known before the loop, or cannot be read."""
        for call in self._unread_calls:
            if not any(map(self._evaluator.is_off, call.guards)):
                yield call

    def _lists(self) -> Iterator[ast.expr]:
        """Yield names that are passed to a function together with the number, and may be lists of iterations."""
        for call in (node for statement in self._body for node in ast.walk(statement)):
            if isinstance(call, ast.Call):
                given = [*call.args, *(keyword.value for keyword in call.keywords)]
                if any(isinstance(value, ast.Name) and value.id == self._target for value in given):
                    yield from (value for value in given if isinstance(value, (ast.Name, ast.Attribute)))

    def _lookups(self) -> Iterator[Condition]:
        """Yield `number in table` for each dictionary in which the loop, or a function, looks up the number."""
        for function, node in self._nodes():
            match node:
                case ast.Subscript(table, key, ast.Load()) | ast.Call(ast.Attribute(table, "get"), [key, *_]):
                    if self._evaluator.mentions(key) and isinstance(self._evaluator.value(table), dict):
                        test = ast.copy_location(ast.Compare(key, [ast.In()], [table]), node)
                        yield Condition(test, (), function)
                case ast.Assign(value=ast.Call(ast.Attribute(table, "pop"), [key, *_])):
                    held = value_of(table, self._names, ())  # before the loop takes anything out
                    if self._evaluator.mentions(key) and isinstance(held, dict) and is_plain([*held]):
                        keys = ast.Tuple([ast.Constant(one) for one in held], ast.Load())
                        test = ast.copy_location(ast.Compare(key, [ast.In()], [keys]), table)
                        yield Condition(test, (), function)

    def _nodes(self) -> Iterator[tuple[InlinedFunction | None, ast.AST]]:
        """Yield all nodes of the loop, with None, and of each function that it calls, with the function."""
        bodies = [(None, self._body), *((one, one.body) for one in self._by_call.values())]
        return ((one, part) for one, body in bodies for statement in body for part in ast.walk(statement))

    def _bar_if_of(self, condition: Condition) -> ast.If | None:
        """Return the outermost `if` that only advances a progress bar and has or contains this condition."""
        own = condition.function is None
        return next((one for one in self._bar_ifs if own and is_inside(condition.test, one)), None)

    def _where(self, condition: Condition) -> str:
        """Return the line of a condition, and its file if that is not the file of the loop."""
        code = self._code_of(condition)
        line, file = line_in_file(condition.test, code), code.co_filename
        return f"line {line}" if file == self._code.co_filename else f"line {line} of {Path(file).name}"

    def _code_of(self, condition: Condition) -> CodeType:
        return self._code if condition.function is None else condition.function.code

    def _location(self, condition: Condition) -> str:
        """Return the number of the line, the file and the text of a condition, as warnings show them."""
        code = self._code_of(condition)
        return f"{line_in_file(condition.test, code)} of {code.co_filename} ({ast.unparse(condition.test)})"

    def _warn_of(self, conditions: Iterable[Condition], sentence: str) -> None:
        """Warn of each condition that no warning has named. The sentence follows "Line ..."."""
        for location in self._without_warning(map(self._location, conditions)):
            caution(f"Line {location} {sentence}", stacklevel=3)

    def _without_warning(self, locations: Iterable[str]) -> list[str]:
        """Return the conditions that no warning has named; they are evaluated for each phase."""
        found = [location for location in dict.fromkeys(locations) if location not in self._warned_of]
        self._warned_of.update(found)
        return found


def _rarer(evaluator: Evaluator, condition: Condition, numbers: range) -> set[int] | None:
    """Return the numbers of the rarer of a condition's two branches, whatever else the condition depends on.

    The result is None if the condition depends on a value that the loop changes.
    """
    found: set[int] = set()
    try:
        for holds, others in evaluator.branches(numbers, condition.test, condition.guards):
            found |= holds if len(holds) <= len(others) else others
    except DependsOnLoop:
        return None
    return found


def _is_list(value: Any) -> bool:
    """Whether this can be a list of iterations. A range without gaps is the whole run."""
    if isinstance(value, range):
        return value.step != 1
    return isinstance(value, (list, tuple, set, frozenset)) and all(isinstance(entry, Integral) for entry in value)
