"""Larger, shrinking steps: each optimizer step runs with changed learning rates and beta2, which are then restored."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from threading import get_ident
from typing import Any

import torch
from torch.optim.optimizer import register_optimizer_step_pre_hook
from torch.utils.hooks import RemovableHandle

from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.optimizers import Optimizers, with_names
from skipgs_plug.core.pace.fading import Fading
from skipgs_plug.core.pace.optimizer_steps import OptimizerSteps
from skipgs_plug.core.pace.parts import UNCHANGED, Division, GrowingParts, OptimizerInfo, ScaledGroup
from skipgs_plug.core.pace.size_bound import SizeBound
from skipgs_plug.core.pace.visibility import VISIBLE, Visibility

# Least share of the iterations that steps are made longer for. With a smaller share, steps that conserve the whole path
# are so long that they lose more than the path gains.
LEAST_PATH_SHARE = 0.25
# Number of steps of refinement from which the path that the trainer's own run travels is enough. In a short schedule
# the own run has not arrived at its end either, and steps are up to `LONGEST` times as long, by the root of the lack
# of steps. In 550 to 600 of 1,500 iterations, 1.6 times the factor gains 0.27 dB on Lego, 0.11 on fern, 0.08 on bonsai
# at 200 pixels, and 0.17 and 0.09 with Inria's script at 100 pixels (two draws). 2.5 times loses 0.08 at 200 pixels.
# Where networks decode the features of anchors, longer steps harm: Scaffold-GS loses .022 SSIM on bonsai.
ENOUGH_STEPS = 1500
LONGEST = 1.6
# Number of iterations in a row that ran with larger steps while no optimizer of PyTorch stepped. After the first number
# the user is warned, after the second an error is raised.
UNSTEPPED_WARNS, UNSTEPPED_RAISES = 50, 200

_hooked: list[ScaledRates] = []  # every instance whose hooks PyTorch holds


def path_factor(
    share: float,
    progress: float,
    peak: float | None = None,
    visible: float | None = None,
    steps: float | None = None,
) -> float:
    """Return the factor on learning rates at a point of refinement, when a share of the iterations runs.

    Adam's steps are about as long as its learning rate, and refinement is limited by how far parameters travel. A share
    of the steps travels as far as all steps do when its mean length is 1 / share. The noise of a Gaussian's step does
    not depend on how often views show it. The part of its steps that views agree on grows with the square root of that
    frequency, and so does the step length that training tolerates. The factor therefore begins with
    2 sqrt(3 visible) / share, which conserves the path if a view shows a third of the Gaussians. It falls linearly to
    0, the shape that averages out the noise of the last steps (Defazio et al., arXiv 2310.07831). In few steps it is up
    to `LONGEST` times as large, if `visible` is known. It is not known for models that are no Gaussians, such as the
    anchors of Scaffold-GS.

    Args:
        share: Share of the iterations that run, in (0, 1]. A share below a quarter gets the steps of a quarter.
        progress: Share of refinement that is over, in [0, 1].
        peak: Factor at the beginning, in place of the formula.
        visible: Share of the Gaussians that a view shows, in (0, 1]; None if it is not known.
        steps: Number of steps of refinement; None if they are as many as in the trainer's own run, or if its optimizers
            accumulate gradients.
    """
    if peak is None:
        peak = 2.0 * math.sqrt(3.0 * (VISIBLE if visible is None else visible)) / max(share, LEAST_PATH_SHARE)
        if steps is not None and visible is not None:
            peak *= min(LONGEST, max(1.0, math.sqrt(ENOUGH_STEPS / max(steps, 1.0))))
    return peak * (1.0 - progress)


class ScaledRates:
    """Multiplies the learning rates of optimizers that step in this thread, and restores them after each step.

    If a group has `betas`, as Adam's groups have, the second is at most `SQUARES_KEPT` during the step.

    The class uses PyTorch's own hooks: one before `step` of every optimizer, and, from its first larger step until
    `remove`, one after `step` of that optimizer. They reach fused, sparse and selective optimizers alike. They never
    disturb the trainer's schedule, and a checkpoint holds the trainer's rates.

    Only parameters with a row for each Gaussian take larger steps. The number of Gaussians is known as soon as an
    optimizer of their positions has stepped. A trainer also steps exposures, camera poses and networks. They must not
    follow a model that is far off for a while: their steps are a quarter as long as the trainer's, and shrink with
    those of the Gaussians.

    Args:
        only: Returns the optimizers whose rates are scaled, by name if their groups have no names. None scales every
            optimizer that steps.

    Attributes:
        only: The argument.
        visibility: Share of the Gaussians that a view shows, measured in the steps scaled so far.
        fading: Whether opacities fall in the first steps.
        sizes: Bound on longer steps of scales.
        opacity_rate: See `Division`.
        positions_rate: See `Division`.
        on_error: Receives errors of hooks, and raises them or releases the gate. None raises them.
    """

    def __init__(self, only: Optimizers | None = None) -> None:
        self.only = only
        self.visibility = Visibility()
        self.fading = Fading()
        self.sizes = SizeBound()
        self.on_error: Callable[[Exception], None] | None = None
        self._factor: float | None = None
        self.opacity_rate, self.positions_rate = 0.0, math.inf
        self._constant_alone = False  # whether a group told that the colours have a constant band only
        self._division = Division(0, None, True)
        self._rows = self._rows_now = 0  # number of Gaussians in the previous and in this iteration; 0 if unknown
        self._thread = get_ident()
        self._under_way: list[OptimizerSteps] = []  # each was called by the step before it in the list
        self._handles: list[RemovableHandle] = []
        self._steps: dict[int, OptimizerSteps] = {}  # by id of the optimizer
        self._foreign: set[int] = set()  # ids of optimizers that stepped in this iteration and are not scaled
        self._unstepped = 0  # number of iterations in a row that ran without a step
        self._removed = False

    def look(self) -> None:
        """Count the Gaussians, and those that the next view shows; change no rate.

        Raises:
            SkipGSError: Another gate scales the same steps; see `scale`.
        """
        self.scale(1.0, UNCHANGED)

    def scale(self, factor: float, growing: GrowingParts | None = None) -> None:
        """Scale the next steps in the thread that calls this, which is the training thread; see `group_part`.

        Args:
            factor: Factor on learning rates.
            growing: While the scene grows, the parts of opacities and positions. `factor` is at least 1 then, and
                parameters that it does not make longer steps for keep their settings. None in refinement.

        Raises:
            SkipGSError: Another gate scales steps in this thread, and one of the two does not know its own optimizers.
        """
        self.pause()
        if self._removed:
            return
        thread = get_ident()
        for other in _hooked:
            at_work = other is not self and other._factor is not None and other._thread == thread
            if at_work and (other.only is None or self.only is None):
                raise SkipGSError(
                    "Another gate makes steps larger in this thread, and each gate would scale the steps of both: "
                    "detach() it first, or train in separate threads."
                )
        self._factor, self._thread = factor, thread
        self._rows, self._rows_now = self._rows_now or self._rows, 0
        self._divide(self._rows, growing, growing is None or factor != 1.0)
        if not self._handles:
            _hooked.append(self)
            self._handles = [register_optimizer_step_pre_hook(self._before_step)]

    @property
    def rows(self) -> int:
        """Number of Gaussians in the last step of their positions; 0 if it is not known."""
        return self._rows_now or self._rows

    def pause(self) -> None:
        """Leave all rates alone until the next `scale`."""
        self._factor = None
        for step in self._under_way:  # a step that raised has no end
            step.drop()
        self._under_way.clear()
        self._foreign.clear()

    def remove(self) -> None:
        """Remove the hooks for good."""
        self.pause()
        self._removed = True
        for handles in (self._handles, *(steps.handles for steps in self._steps.values())):
            while handles:
                handles.pop().remove()
        if self in _hooked:
            _hooked.remove(self)

    def ran(self) -> None:
        """Note that a backward pass ran in the present iteration, so that an optimizer is about to step.

        Raises:
            SkipGSError: No optimizer has stepped for many iterations, so larger steps have no effect.
        """
        if self._factor is None or self._factor == 1.0:
            return
        self._unstepped += 1
        if self._unstepped in (UNSTEPPED_WARNS, UNSTEPPED_RAISES):
            sentence = (
                f"{self._unstepped} iterations ran with larger steps, and no torch.optim.Optimizer stepped in the "
                "thread of the loop. The optimizer of this loop is not one of PyTorch's, or steps elsewhere, so its "
                "steps are not larger: derive it from torch.optim.Optimizer, let it read the lr of its param_groups, "
                "and step in the thread of the loop, or give compensate=False (--compensate False)."
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
            if step is None:
                return
            step.depth += 1
            if step.depth > 1:  # a step can call the step of its base class
                return
            if self._under_way:
                self._pass_on(optimizer)
            info = step.info
            if not info.fits(optimizer):
                info = step.info = OptimizerInfo(optimizer, info.name)
            self._constant_alone |= info.no_bands
            if info.positions:
                self._count(info)
            if info.opacities is not None and self._division.growing is not None:
                self.fading.see(info.opacities)
            if info.division is not self._division:
                info.divide(self._division)
            self._unstepped = 0
            step.begin(optimizer, self._not_begun(info.scaled) if self._under_way else info.scaled, factor)
        except Exception as error:
            self._failed(error)

    def _failed(self, error: Exception) -> None:
        """Handle an error of a hook: raise it, or pass it to `on_error`, after which the trainer's step goes on."""
        if self.on_error is None:
            raise error
        self.on_error(error)

    def _count(self, info: OptimizerInfo) -> None:
        """Count the Gaussians, and those that the view shows, in positions that are about to step."""
        if not self.visibility.complete:
            self.visibility.see(info.positions)
        if info.known_positions is not None:
            self.sizes.measure(info.known_positions)
            self._rows = self._rows_now = info.known_positions.shape[0]
        else:  # in groups without names, positions of cameras have the shape of positions of Gaussians, but fewer rows
            self._rows_now = max(self._rows_now, *(param.shape[0] for param in info.positions))
        self._divide(max(self._rows_now, self._rows), self._division.growing, self._division.raised)

    def _divide(self, rows: int, growing: GrowingParts | None, raised: bool) -> None:
        """Set the division; an equal one stays the same object, so that optimizers compare it fast."""
        division = (rows, growing, raised, self.opacity_rate, self.positions_rate, self._constant_alone)
        if division != self._division:
            self._division = Division(*division)

    def _not_begun(self, scaled: list[ScaledGroup]) -> list[ScaledGroup]:
        """Leave out groups of steps that are under way: an optimizer can wrap another one that has the same groups."""
        begun = {id(group) for other in self._under_way for group, _, _ in other.before}
        return [one for one in scaled if id(one.group) not in begun]

    def _begin_with(self, optimizer: torch.optim.Optimizer) -> OptimizerSteps | None:
        """Create `OptimizerSteps` for an optimizer that steps for the first time; None if it is not scaled."""
        key, name = id(optimizer), None
        if self.only is not None:
            if key in self._foreign:
                return None
            names = [name for name, one in with_names(self.only()) if one is optimizer]
            if not names:
                self._foreign.add(key)
                return None
            name = names[0]
        step = OptimizerSteps(optimizer, name, self._under_way, self.sizes, self._failed)
        step.handles = self._watch(optimizer, step)
        self._steps[key] = step
        # Python can give the id of a deleted optimizer to a new one.
        step.gone = weakref.ref(optimizer, lambda _, steps=self._steps: steps.pop(key, None))  # type: ignore[misc]
        return step

    def _pass_on(self, optimizer: torch.optim.Optimizer) -> None:
        """Stop watching outer steps that share groups with this optimizer, which steps inside them."""
        for other in self._under_way:
            if other.own is not None and other.own.shares_groups(optimizer.param_groups):
                other.own.stop_watching()

    def _watch(self, optimizer: torch.optim.Optimizer, step: OptimizerSteps) -> list[RemovableHandle]:
        """Add the hooks that restore the trainer's settings before other code reads them."""
        ends = optimizer.register_step_post_hook(step.after_step)
        # The trainer's own hooks after a step, such as a scheduler's, must find the trainer's rates.
        optimizer._optimizer_step_post_hooks.move_to_end(ends.id, last=False)  # type: ignore[attr-defined]
        # A checkpoint that is written after a step raised holds the trainer's rates too.
        return [ends, optimizer.register_state_dict_pre_hook(self._put_back_all)]

    def _put_back_all(self, _: torch.optim.Optimizer) -> None:
        for step in self._under_way:
            step.put_back()
