"""Larger, shrinking steps: other learning rates and a shorter memory, for the length of each optimizer step only."""

from __future__ import annotations

import contextlib
import math
import weakref
from collections.abc import Callable, Iterable, Mapping
from threading import get_ident
from typing import Any

import torch
from torch.optim.optimizer import register_optimizer_step_pre_hook
from torch.utils.hooks import RemovableHandle

from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pace.parts import OptimizerInfo
from skipgs_plug.core.pace.step_reads import LiteralBetas, WatchedGroup, is_torchs, shorter_memory, unwatch, watch
from skipgs_plug.core.pace.visibility import Visibility

Named = Callable[[], Mapping[str, torch.optim.Optimizer]]
Optimizers = Named | Callable[[], Iterable[torch.optim.Optimizer]]

LEAST_PATH_SHARE = 0.25  # of the iterations; below, steps that are longer still lose more than the path gains
VISIBLE = 1 / 3  # of the Gaussians by a view, where it is not known: as in a room photographed from within
# Of Adam's running mean of squares (beta2), at most. By the gradient of a single view a parameter can move its rate
# over the root of 1 - beta2: 32 times the rate at the usual 0.999, too far where rates are larger.
SQUARES_KEPT = 0.98
# Iterations in a row that ran with larger steps while no optimizer of PyTorch stepped: then a warning, then an error.
UNSTEPPED_WARNS, UNSTEPPED_RAISES = 50, 200

_hooked: list[ScaledRates] = []  # all whose hooks PyTorch holds


def path_factor(share: float, progress: float, peak: float | None = None, visible: float | None = None) -> float:
    """Factor on learning rates at some progress through refinement, when a share of the iterations runs.

    Adam's steps are about as long as its learning rate, and refinement is limited by how far parameters travel: a
    share of the steps goes as far as all of them when their mean length is 1 / share. Chance is as large in each step
    of a Gaussian, however rarely a view shows it, and what the views agree on grows with the root of how often they do:
    with it grows what steps bear. So the factor begins with 2 sqrt(3 visible) / share, which conserves the path where a
    view shows a third of the Gaussians, and falls linearly to 0, the shape that averages the noise of the last steps
    out (Defazio et al., arXiv 2310.07831).

    Args:
        share: Share of the iterations that run, in (0, 1]; one below a quarter gets the steps of a quarter.
        progress: Share of refinement that is over, in [0, 1].
        peak: Factor at the beginning, instead of that.
        visible: Share of the Gaussians that a view shows, in (0, 1]; None where it is not known.
    """
    if peak is None:
        peak = 2.0 * math.sqrt(3.0 * (VISIBLE if visible is None else visible)) / max(share, LEAST_PATH_SHARE)
    return peak * (1.0 - progress)


class ScaledRates:
    """Multiplies the learning rates of optimizers that step in this thread, and puts them back afterwards.

    Where a group has `betas`, as Adam's have, the second is at most `SQUARES_KEPT` for the length of the step.

    PyTorch's own hooks are used, around `step` of every optimizer and, from its first larger step until `remove`, on
    the optimizer itself: so fused, sparse and selective optimizers are reached alike, the trainer's schedule is never
    disturbed, and a checkpoint holds the trainer's rates.

    Only what has a row for each Gaussian takes larger steps, as soon as an optimizer has shown how many there are by
    their positions. Exposures, camera poses and networks, which a trainer steps beside them, must not run after a model
    that is far off meanwhile: their steps are a quarter as long as the trainer's, and shrink with the others.

    Args:
        only: Gives the optimizers that are meant, by name where their groups have none; None for all that step, of
            which the trainer alone knows.

    Attributes:
        only: as given.
        visibility: share of the Gaussians that a view shows, by the steps scaled so far.
        on_error: Told of errors in hooks, which it raises or has let go of the training; None raises them.
    """

    def __init__(self, only: Optimizers | None = None) -> None:
        self.only = only
        self.visibility = Visibility()
        self.on_error: Callable[[Exception], None] | None = None
        self._factor: float | None = None
        self._growing = False
        self._only_look = False
        self._rows = self._rows_now = 0  # Gaussians in the iteration before and in this one; 0 where not known
        self._thread = get_ident()
        self._under_way: list[_Steps] = []  # each within the step of the one before
        self._handles: list[RemovableHandle] = []
        self._steps: dict[int, _Steps] = {}  # by id of the optimizer
        self._foreign: set[int] = set()  # ids of optimizers that stepped in this iteration and are not meant
        self._unstepped = 0  # iterations in a row that ran without a step
        self._removed = False

    def look(self) -> None:
        """Measure what the next view shows and how many Gaussians there are, and change nothing.

        Raises:
            SkipGSError: As `scale`.
        """
        self.scale(1.0)
        self._only_look = True

    def scale(self, factor: float, growing: bool = False) -> None:
        """Scale the steps of the thread that calls this, which is the one that trains; see `group_factor`.

        Args:
            factor: On learning rates.
            growing: The scene still grows: opacities take up to `OPACITIES_GROWING` times their rate, and parameters
                without a row for each Gaussian are left alone.

        Raises:
            SkipGSError: Another one scales steps in this thread, and one of the two does not know which are its own.
        """
        self.pause()
        if self._removed:
            return
        thread = get_ident()
        for other in _hooked:
            at_work = other is not self and other._factor is not None and other._thread == thread
            if at_work and (other.only is None or self.only is None):
                raise SkipGSError(
                    "Another gate makes steps larger in this thread, and each would scale those of both: detach() it "
                    "first, or train in threads of their own."
                )
        self._factor, self._growing, self._only_look, self._thread = factor, growing, False, thread
        self._rows, self._rows_now = self._rows_now or self._rows, 0
        if not self._handles:
            _hooked.append(self)
            self._handles = [register_optimizer_step_pre_hook(self._before_step)]

    @property
    def rows(self) -> int:
        """Number of Gaussians in the last step of their positions; 0 if it is not known."""
        return self._rows_now or self._rows

    def pause(self) -> None:
        """Touch nothing until the next `scale`."""
        self._factor = None
        for step in self._under_way:  # one that raised had no end
            step.drop()
        self._under_way.clear()
        self._foreign.clear()

    def remove(self) -> None:
        """Take the hooks back, for good."""
        self.pause()
        self._removed = True
        for handles in (self._handles, *(steps.handles for steps in self._steps.values())):
            while handles:
                handles.pop().remove()
        if self in _hooked:
            _hooked.remove(self)

    def ran(self) -> None:
        """A backward ran in the present iteration, so that some optimizer is about to step.

        Raises:
            SkipGSError: None has stepped for many iterations: larger steps do not arrive.
        """
        if self._factor is None or self._factor == 1.0:
            return
        self._unstepped += 1
        if self._unstepped in (UNSTEPPED_WARNS, UNSTEPPED_RAISES):
            sentence = (
                f"{self._unstepped} iterations ran with larger steps, and no torch.optim.Optimizer stepped: what "
                "updates the parameters is none, so its steps are not larger. Derive it from torch.optim.Optimizer and "
                "let it read the lr of its param_groups, or give compensate=False."
            )
            if self._unstepped == UNSTEPPED_RAISES:
                raise SkipGSError(sentence)
            caution(sentence)

    def _before_step(self, optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        """Hook of PyTorch: an optimizer is about to step."""
        factor = self._factor
        if factor is None or get_ident() != self._thread:
            return
        try:
            step = self._steps.get(id(optimizer)) or self._begin_with(optimizer)
            if step is not None:
                step.depth += 1
                if step.depth == 1:  # a step can call the step of its base class
                    self._scale(optimizer, step, factor)
        except Exception as error:
            self._failed(error)

    def _failed(self, error: Exception) -> None:
        """Raise an error of a hook, or tell the one who lets go of the training, whose step then goes on."""
        if self.on_error is None:
            raise error
        self.on_error(error)

    def _scale(self, optimizer: torch.optim.Optimizer, step: _Steps, factor: float) -> None:
        under_way = self._under_way
        if under_way:
            self._pass_on(optimizer)
        info = step.info
        if not info.fits(optimizer):
            info = step.info = OptimizerInfo(optimizer, info.name)
        self._unstepped = 0
        if not self.visibility.complete:
            self.visibility.see(optimizer.param_groups, info.name)
        # Without names a camera's position has the shape of a Gaussian's, but there are fewer.
        for param in info.positions:
            if param.shape[0] > self._rows_now:
                self._rows_now = param.shape[0]
        rows = self._rows_now if self._rows_now > self._rows else self._rows
        if info.rows != rows or info.growing is not self._growing:
            info.divide(rows, self._growing)
        shares = [] if self._only_look else info.shares
        if under_way:  # an optimizer can be wrapped in another one, which has the same groups
            scaled = {id(group) for other in under_way for group, _, _ in other.before}
            shares = [one for one in shares if id(one.group) not in scaled]
        under_way.append(step)
        before = step.before
        for group, part, most, longer in shares:
            times = part * (factor if factor < most else most)
            rate, betas = group.get("lr"), group.get("betas")
            before.append((group, rate, betas))
            if betas is not None and longer is not None:
                group["betas"] = longer.short if betas is longer.betas else longer.shorter(betas, SQUARES_KEPT)
                if step.memory_stays:
                    times = max(min(times, 1.0), times * shorter_memory(betas, SQUARES_KEPT))
            if rate is not None:
                group["lr"] = rate * times
            if not step.judged and longer is not None and times != 1.0 and longer.has_gradient():
                step.longer.append(group)
        if step.longer or step.literal is not None:
            step.prepare(optimizer)

    def _begin_with(self, optimizer: torch.optim.Optimizer) -> _Steps | None:
        """Make `_Steps` for an optimizer that was not seen before; None if it is not meant."""
        key, name = id(optimizer), None
        if self.only is not None:
            if key in self._foreign:
                return None
            own = self.only()
            named = own.items() if isinstance(own, Mapping) else ((None, one) for one in own)
            names = [name for name, one in named if one is optimizer]
            if not names:
                self._foreign.add(key)
                return None
            name = names[0]
        step = _Steps(optimizer, name, self._under_way, self._failed)
        step.handles = self._watch(optimizer, step)
        self._steps[key] = step
        # Its number is given to another optimizer once it is gone.
        step.gone = weakref.ref(optimizer, lambda _, steps=self._steps: steps.pop(key, None))  # type: ignore[misc]
        return step

    def _pass_on(self, optimizer: torch.optim.Optimizer) -> None:
        """An optimizer that is wrapped in another one steps inside its step, with the same groups."""
        own = {id(group) for group in optimizer.param_groups}
        for other in self._under_way:
            if other.watched is not None and any(id(one) in own or id(one.group) in own for one in other.watched):
                other.stop_watching()

    def _watch(self, optimizer: torch.optim.Optimizer, step: _Steps) -> list[RemovableHandle]:
        """Put the trainer's settings back before anybody else looks at them."""
        ends = optimizer.register_step_post_hook(step.end)
        # The trainer's own hooks after a step, of a scheduler for example, find and set its rates.
        optimizer._optimizer_step_post_hooks.move_to_end(ends.id, last=False)  # type: ignore[attr-defined]
        # A checkpoint is written although a step raised: it holds the trainer's rates, too.
        return [ends, optimizer.register_state_dict_pre_hook(self._put_back_all)]

    def _put_back_all(self, _: torch.optim.Optimizer) -> None:
        for step in self._under_way:
            step.put_back()


class _Steps:
    """The steps of one optimizer: facts about its groups, and the settings that its trainer has while one is under way.

    Args:
        optimizer: It steps.
        name: Of it, where its groups have none; None if unknown.
        under_way: Steps that have begun and not ended, the outermost first.
        failed: Told of errors at the end of a step, which it raises or has let go of the training.

    Attributes:
        info: about its groups.
        handles: of hooks on it.
        gone: forgets these steps with the optimizer.
        depth: calls of its `step` within each other.
        before: groups, and the rate and betas that the trainer has set there; None for a setting that it lacks.
        longer: groups with a gradient whose rates are other ones now; filled until it is judged.
        watched: copies in place of all groups, in the first longer step of an optimizer that is not PyTorch's.
        judged: whether it is known what its step reads.
        literal: replaces betas that its step passes as literal numbers; None if it passes none.
        memory_stays: whether its step keeps a memory of squares that cannot be made shorter from outside.
    """

    __slots__ = (
        *("_failed", "_under_way", "_until_end", "before", "depth", "info", "gone", "handles", "judged"),
        *("literal", "longer", "memory_stays", "watched"),
    )

    def __init__(
        self,
        optimizer: torch.optim.Optimizer,
        name: str | None,
        under_way: list[_Steps],
        failed: Callable[[Exception], None],
    ) -> None:
        self.info = OptimizerInfo(optimizer, name)
        self.handles: list[RemovableHandle] = []
        self.gone: Any = None
        self._under_way, self._failed = under_way, failed
        self.depth = 0
        self.before: list[tuple[dict[str, Any], Any, Any]] = []
        self.longer: list[dict[str, Any]] = []
        self.watched: list[WatchedGroup] | None = None
        self.judged = is_torchs(optimizer)
        self.literal: LiteralBetas | None = None
        self.memory_stays = False
        self._until_end: contextlib.ExitStack | None = None

    def end(self, optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        """Hook of PyTorch: a step has ended; the settings are the trainer's again before anybody else looks."""
        if self.depth == 0:
            return
        self.depth -= 1
        if self.depth:
            return
        try:
            self._under_way.remove(self)
            self.put_back()
            if self.watched is not None:
                self.judge(optimizer)
        except Exception as error:
            self._failed(error)

    def drop(self) -> None:
        """A step that has begun has no end: it raised."""
        self.depth = 0
        self.put_back()
        self.watched = None
        self.longer.clear()

    def prepare(self, optimizer: torch.optim.Optimizer) -> None:
        """See what the first longer step reads; replace literal betas, which it may pass on."""
        self._until_end = contextlib.ExitStack()
        if not self.judged:
            betas = next((betas for _, _, betas in self.before if betas is not None), None)
            self.literal = None if betas is None else LiteralBetas(optimizer, betas, SQUARES_KEPT)
            self.watched = watch(optimizer.param_groups)
            self._until_end.callback(unwatch, optimizer.param_groups)
        if self.literal is not None:
            self._until_end.enter_context(self.literal.in_place())

    def stop_watching(self) -> None:
        """Nothing is to be said of this step, whose groups another optimizer inside it uses."""
        if self._until_end is not None:
            self._until_end.close()
        self.watched = self.literal = None

    def put_back(self) -> None:
        """Once: what the trainer sets afterwards stays."""
        for group, rate, betas in self.before:
            if rate is not None:
                group["lr"] = rate
            if betas is not None:
                group["betas"] = betas
        self.before.clear()
        if self._until_end is not None:
            self._until_end.close()
            self._until_end = None

    def judge(self, optimizer: torch.optim.Optimizer) -> None:
        """Say what the watched step read, which has ended.

        Raises:
            SkipGSError: Not the learning rates: larger steps never arrive.
        """
        watched, self.watched = self.watched or [], None
        longer = [group for group in watched if any(group.group is one for one in self.longer)]
        self.judged = True
        self.longer.clear()
        kind = type(optimizer).__name__
        if any("lr" not in group.read or "lr" not in group for group in longer):
            raise SkipGSError(
                f"Steps of {kind} do not read the lr of its param_groups, so they are not larger; let it read them, or "
                "give compensate=False."
            )
        fixed = [group for group in longer if "betas" in group and "betas" not in group.read]
        if fixed and self.literal is not None and self.literal.replaced:
            return
        self.literal, self.memory_stays = None, bool(fixed)
        if fixed:
            bound = shorter_memory(fixed[0].group["betas"], SQUARES_KEPT)
            caution(
                f"Steps of {kind} do not read the betas of its param_groups, so squares of gradients cannot be "
                f"forgotten sooner: its learning rates are raised {bound:.2f} times as far."
            )
