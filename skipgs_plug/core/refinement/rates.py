"""Larger, shrinking steps: a factor on every learning rate, for the length of each optimizer step only."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch.optim.optimizer import register_optimizer_step_post_hook, register_optimizer_step_pre_hook

Optimizers = Callable[[], Iterable[torch.optim.Optimizer]]
Named = Callable[[], Mapping[str, torch.optim.Optimizer]]

# What a group of parameters takes of the factor that is meant for all. The higher bands of the colours, whose rate
# trainers set to a twentieth of the constant band's, bear the longest steps; opacities none beyond the trainer's.
HIGHER_BANDS, CONSTANT_BAND, POSITIONS, OTHERS = 4.0, 2.0, 2.0, 1.0
NAMED = {
    **dict.fromkeys(("f_rest", "shN", "features_rest"), HIGHER_BANDS),
    **dict.fromkeys(("f_dc", "sh0", "features_dc"), CONSTANT_BAND),
    **dict.fromkeys(("xyz", "means"), POSITIONS),
}
OPACITIES = ("opacity", "opacities")
MOST = 8.0  # beyond, scenes of many overlapping Gaussians lose more by steps than by a shorter path


def path_factor(share: float, progress: float, peak: float | None = None) -> float:
    """Factor on learning rates at some progress through refinement, when a share of the iterations runs.

    Adam's steps are about as long as its learning rate, and refinement is limited by how far parameters travel: a
    share of the steps goes as far as all of them when their mean length is 1 / share. The factor falls linearly from
    twice that, at most 8, to 0, the shape that averages the noise of the last steps out (Defazio et al., arXiv
    2310.07831).

    Args:
        share: Share of the iterations that run, in (0, 1].
        progress: Share of refinement that is over, in [0, 1].
        peak: Factor at the beginning, instead of that.
    """
    return (min(2.0 / share, MOST) if peak is None else peak) * (1.0 - progress)


def group_factor(group: dict[str, Any], factor: float, name: str | None = None) -> float:
    """Factor on the learning rate of a group of an optimizer, where `factor` is that of all.

    The image is linear in the colours, so SH coefficients bear longer steps. So do positions, whose rate has fallen to
    a tenth of what it began with when refinement begins. Opacities are never raised: their rate is large as it is, and
    steps beyond it flicker. All are known by the group's name, or else the `name` of its optimizer; without either by
    shape: [N, 1, 3] is the constant band of the SH coefficients, [N, K, 3] are the others, [N, 1] opacities.
    """
    name = group.get("name", name)
    if name is not None:
        return min(factor, 1.0) if name in OPACITIES else NAMED.get(name, OTHERS) * factor
    shapes = [tuple(param.shape[1:]) for param in group["params"]]
    if all(shape == (1,) for shape in shapes):
        return min(factor, 1.0)
    if all(len(shape) == 2 and shape[1] == 3 for shape in shapes):
        return (CONSTANT_BAND if all(shape[0] == 1 for shape in shapes) else HIGHER_BANDS) * factor
    return factor


class ScaledRates:
    """Multiplies the learning rates of optimizers that step in this thread, and puts them back afterwards.

    PyTorch's own hooks around `step` are used, so fused, sparse and selective optimizers are reached alike, the
    trainer's schedule is never disturbed, and a checkpoint holds the trainer's rates.

    Args:
        only: Gives the optimizers that are meant; None for all that step, of which the trainer alone knows.
        named: Gives the trainer's names of optimizers whose groups have none.

    Attributes:
        factor: in force, see `group_factor`; None touches nothing.
    """

    def __init__(self, only: Optimizers | None = None, named: Named | None = None) -> None:
        self.factor: float | None = None
        self._only, self._named = only, named
        self._thread = threading.get_ident()
        self._depth: dict[int, int] = {}  # a step can call the step of its base class
        self._before: dict[int, list[tuple[dict[str, Any], Any]]] = {}
        self._handles = (
            register_optimizer_step_pre_hook(self._scale),
            register_optimizer_step_post_hook(self._put_back),
        )

    def follow_thread(self) -> None:
        """Scale the steps of the thread that calls this, which is the one that trains."""
        self._thread = threading.get_ident()
        if self._before:  # a step that raised had no end
            for saved in self._before.values():
                _restore(saved)
            self._before.clear()
            self._depth.clear()

    def remove(self) -> None:
        """Take the hooks back."""
        self.follow_thread()
        for handle in self._handles:
            handle.remove()

    def _scale(self, optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        if self.factor is None or threading.get_ident() != self._thread:
            return
        if self._only is not None and not any(optimizer is one for one in self._only()):
            return
        key = id(optimizer)
        self._depth[key] = self._depth.get(key, 0) + 1
        if self._depth[key] > 1:
            return
        self._before[key] = [(group, group["lr"]) for group in optimizer.param_groups]
        name = self._name(optimizer)
        for group in optimizer.param_groups:
            group["lr"] = group["lr"] * group_factor(group, self.factor, name)

    def _name(self, optimizer: torch.optim.Optimizer) -> str | None:
        named = {} if self._named is None else self._named()
        return next((name for name, one in named.items() if one is optimizer), None)

    def _put_back(self, optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        key = id(optimizer)
        if key not in self._depth:
            return
        self._depth[key] -= 1
        if self._depth[key] == 0:
            del self._depth[key]
            _restore(self._before.pop(key))


def _restore(saved: list[tuple[dict[str, Any], Any]]) -> None:
    for group, rate in saved:
        group["lr"] = rate
