"""Larger, shrinking steps: other learning rates and a shorter memory, for the length of each optimizer step only."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch.optim.optimizer import register_optimizer_step_post_hook, register_optimizer_step_pre_hook
from torch.utils.hooks import RemovableHandle

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pace.visibility import Visibility, positions

Named = Callable[[], Mapping[str, torch.optim.Optimizer]]
Optimizers = Named | Callable[[], Iterable[torch.optim.Optimizer]]

# What a group of parameters takes of the factor that is meant for all; opacities take none beyond the trainer's rate.
HIGHER_BANDS, GEOMETRY, OTHERS, CONSTANT_BAND = 4.0, 2.0, 1.0, 0.5
NAMED = {
    **dict.fromkeys(("f_rest", "shN", "features_rest"), HIGHER_BANDS),
    **dict.fromkeys(("f_dc", "sh0", "features_dc"), CONSTANT_BAND),
    **dict.fromkeys(("xyz", "means", "scaling", "scales"), GEOMETRY),
}
OPACITIES = ("opacity", "opacities")
BESIDE = 0.25  # of the trainer's rate, at most, for what has no row for each Gaussian
OF_A_GAUSSIAN = ((), (1,), (2,), (3,), (4,))  # shapes of its parameters beside colours [K, 3]
LONGEST_AT = 0.25  # of the iterations; below, steps that are longer still lose more than the path gains
SHOWN = 1 / 3  # of the Gaussians by a view, where it is not known: as in a room photographed from within
# Of Adam's running mean of squares (beta2), at most. By the gradient of a single view a parameter can move its rate
# over the root of 1 - beta2: 32 times the rate at the usual 0.999, too far where rates are larger.
SQUARES_KEPT = 0.98
SETTINGS = ("lr", "betas")  # of a group, that are other ones for the length of a step

_hooked: list[ScaledRates] = []  # all whose hooks PyTorch holds


def path_factor(share: float, progress: float, peak: float | None = None, shown: float | None = None) -> float:
    """Factor on learning rates at some progress through refinement, when a share of the iterations runs.

    Adam's steps are about as long as its learning rate, and refinement is limited by how far parameters travel: a
    share of the steps goes as far as all of them when their mean length is 1 / share. Chance is as large in each step
    of a Gaussian, however rarely a view shows it, and what the views agree on grows with the root of how often they do:
    with it grows what steps bear. So the factor begins with 2 sqrt(3 shown) / share, which conserves the path where a
    view shows a third of the Gaussians, and falls linearly to 0, the shape that averages the noise of the last steps
    out (Defazio et al., arXiv 2310.07831).

    Args:
        share: Share of the iterations that run, in (0, 1]; one below a quarter gets the steps of a quarter.
        progress: Share of refinement that is over, in [0, 1].
        peak: Factor at the beginning, instead of that.
        shown: Share of the Gaussians that a view shows, in (0, 1]; None where it is not known.
    """
    if peak is None:
        peak = 2.0 * math.sqrt(3.0 * (SHOWN if shown is None else shown)) / max(share, LONGEST_AT)
    return peak * (1.0 - progress)


def group_factor(group: dict[str, Any], factor: float, name: str | None = None) -> float:
    """Factor on the learning rate of a group of an optimizer, where `factor` is that of all.

    The image is linear in the colours, so their higher bands, whose rate trainers set to a twentieth of the constant
    band's, bear the longest steps, and the constant band, which all views agree on, needs shorter ones. Positions,
    whose rate has fallen to a tenth when refinement begins, and scales bear longer steps. Opacities are never raised:
    their rate is large as it is, and steps beyond it flicker. All are known by the group's name, or else the `name` of
    its optimizer; without either by shape: [N, 1, 3] is the constant band, [N, K, 3] higher ones, [N, 1] opacities.
    """
    name = group.get("name", name)
    if name is not None:
        return min(factor, 1.0) if name in OPACITIES else NAMED.get(name, OTHERS) * factor
    shapes = [tuple(param.shape[1:]) for param in group["params"]]
    if all(shape == (1,) for shape in shapes):
        return min(factor, 1.0)
    if all(shape == (1, 3) for shape in shapes):
        return CONSTANT_BAND * factor
    if all(len(shape) == 2 and shape[0] > 1 and shape[1] == 3 for shape in shapes):
        return HIGHER_BANDS * factor
    return factor


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
        shown: share of the Gaussians that a view shows, by the steps scaled so far.
    """

    def __init__(self, only: Optimizers | None = None) -> None:
        self.only = only
        self.shown = Visibility()
        self._factor: float | None = None
        self._evenly = False
        self._rows = self._rows_now = 0  # Gaussians in the iteration before and in this one; 0 where not known
        self._thread = threading.get_ident()
        self._depth: dict[int, int] = {}  # a step can call the step of its base class
        self._under_way: dict[int, _Step] = {}
        self._handles: list[RemovableHandle] = []
        self._watched: WeakKeyDictionary[torch.optim.Optimizer, list[RemovableHandle]] = WeakKeyDictionary()
        self._removed = False

    def scale(self, factor: float, evenly: bool = False) -> None:
        """Scale the steps of the thread that calls this, which is the one that trains; see `group_factor`.

        Args:
            factor: On learning rates.
            evenly: Scale all parameters of the Gaussians by this factor itself, with the trainer's memory of squares,
                and leave everything else alone.

        Raises:
            SkipGSError: Another one scales steps in this thread, and one of the two does not know which are its own.
        """
        self.rest()
        if self._removed:
            return
        thread = threading.get_ident()
        for other in _hooked:
            at_work = other is not self and other._factor is not None and other._thread == thread
            if at_work and (other.only is None or self.only is None):
                raise SkipGSError(
                    "Another gate makes steps larger in this thread, and each would scale those of both: detach() it "
                    "first, or train in threads of their own."
                )
        self._factor, self._evenly, self._thread = factor, evenly, thread
        self._rows, self._rows_now = self._rows_now or self._rows, 0
        if not self._handles:
            _hooked.append(self)
            self._handles = [
                register_optimizer_step_pre_hook(self._scale),
                register_optimizer_step_post_hook(self._put_back),
            ]

    @property
    def rows(self) -> int:
        """Number of Gaussians in the last step of their positions; 0 if it is not known."""
        return self._rows_now or self._rows

    def rest(self) -> None:
        """Touch nothing until the next `scale`."""
        self._factor = None
        for step in self._under_way.values():  # one that raised had no end
            step.put_back()
        self._under_way.clear()
        self._depth.clear()

    def remove(self) -> None:
        """Take the hooks back, for good."""
        self.rest()
        self._removed = True
        for handles in (self._handles, *self._watched.values()):
            while handles:
                handles.pop().remove()
        if self in _hooked:
            _hooked.remove(self)

    def _scale(self, optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        if self._factor is None or threading.get_ident() != self._thread:
            return
        own = {None: optimizer} if self.only is None else self.only()
        named = own.items() if isinstance(own, Mapping) else ((None, one) for one in own)
        names = [name for name, one in named if one is optimizer]
        if not names:
            return
        key = id(optimizer)
        self._depth[key] = self._depth.get(key, 0) + 1
        if self._depth[key] > 1:
            return
        # An optimizer can be wrapped in another one, which has the same groups.
        scaled = {id(group) for step in self._under_way.values() for group, _ in step.before}
        groups = [group for group in optimizer.param_groups if id(group) not in scaled]
        self.shown.see(groups, names[0])
        # Without names a camera's position has the shape of a Gaussian's, but there are fewer.
        self._rows_now = max([self._rows_now, *map(len, positions(groups, names[0]))])
        before = [(group, {name: group[name] for name in SETTINGS if name in group}) for group in groups]
        self._under_way[key] = _Step(before)
        if optimizer not in self._watched:
            self._watched[optimizer] = self._watch(optimizer)
        for group in groups:
            longer = self._of_gaussians(group, names[0])
            if self._evenly:
                if longer and "lr" in group:
                    group["lr"] = group["lr"] * self._factor
                continue
            if "lr" in group:
                factor = group_factor(group, self._factor, names[0]) if longer else BESIDE * min(self._factor, 1.0)
                group["lr"] = group["lr"] * factor
            if longer and "betas" in group:
                first, second, *others = group["betas"]
                group["betas"] = (first, min(second, SQUARES_KEPT), *others)

    def _of_gaussians(self, group: dict[str, Any], name: str | None) -> bool:
        rows = max(self._rows, self._rows_now)
        if rows:
            return all(param.shape[:1] == (rows,) for param in group["params"])
        # Inria's exposures step before the positions do. Groups with names are a model's, of anchors for example.
        shapes = [tuple(param.shape[1:]) for param in group["params"]]
        known = group.get("name", name) is not None
        return known or all(shape in OF_A_GAUSSIAN or (len(shape) == 2 and shape[1] == 3) for shape in shapes)

    def _put_back(self, optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        key = id(optimizer)
        if key not in self._depth:
            return
        self._depth[key] -= 1
        if self._depth[key] == 0:
            del self._depth[key]
            self._under_way.pop(key).put_back()

    def _watch(self, optimizer: torch.optim.Optimizer) -> list[RemovableHandle]:
        """Put the trainer's settings back before anybody else looks at them."""
        ends = optimizer.register_step_post_hook(self._put_back_first)
        # The trainer's own hooks after a step, of a scheduler for example, find and set its rates.
        optimizer._optimizer_step_post_hooks.move_to_end(ends.id, last=False)  # type: ignore[attr-defined]
        # A checkpoint is written although a step raised: it holds the trainer's rates, too.
        return [ends, optimizer.register_state_dict_pre_hook(self._put_back_all)]

    def _put_back_first(self, optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        if self._depth.get(id(optimizer)) == 1:
            self._under_way[id(optimizer)].put_back()

    def _put_back_all(self, _: torch.optim.Optimizer) -> None:
        for step in self._under_way.values():
            step.put_back()


class _Step:
    """A step under way, whose groups have other settings than the trainer's.

    Args:
        before: Groups, and what the trainer has set there.
    """

    def __init__(self, before: list[tuple[dict[str, Any], dict[str, Any]]]) -> None:
        self.before = before
        self._scaled = True

    def put_back(self) -> None:
        """Once: what the trainer sets afterwards stays."""
        if self._scaled:
            for group, settings in self.before:
                group.update(settings)
        self._scaled = False
