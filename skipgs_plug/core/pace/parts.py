"""How each group of parameters shares in the factor on learning rates, and facts about groups that outlast a step."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from skipgs_plug.core.pace.visibility import POSITIONS

SCALES = ("scaling", "scales")
# Multiples of the common factor that groups of parameters take, by kind. In refinement opacities take none.
HIGHER_BANDS, GEOMETRY, OTHERS, CONSTANT_BAND = 4.0, 2.0, 1.0, 0.5
PART_BY_NAME = {
    **dict.fromkeys(("f_rest", "shN", "features_rest"), HIGHER_BANDS),
    **dict.fromkeys(("f_dc", "sh0", "features_dc"), CONSTANT_BAND),
    **dict.fromkeys((*POSITIONS, *SCALES), GEOMETRY),
}
OPACITIES = ("opacity", "opacities")
# Largest learning rate of opacities that must recover from their last reset. They flicker with more.
HIGHEST_RECOVERING_RATE = 0.1
# Largest factor on the rate of parameters without a row for each Gaussian (exposures, poses, networks). They must not
# follow a model that is far off for a while.
OTHERS_AT_MOST = 0.25
# Largest beta2 of Adam during a longer step. The gradient of a single view can move a parameter by its rate divided by
# the root of 1 - beta2: 32 times the rate at the usual 0.999, which is too far with larger rates, 7 times at 0.98.
SQUARES_KEPT = 0.98
GAUSSIAN_SHAPES = ((), (1,), (2,), (3,), (4,))  # shapes of one Gaussian's parameters, except colours [K, 3]


def known_name(name: str | None) -> str | None:
    """Return the name of a group without its prefix: `point_cloud.position`, `Background#xyz` and `_xyz` have one."""
    return None if name is None else re.split(r"[.#/]", str(name))[-1].lstrip("_")


def group_part(group: dict[str, Any], name: str | None = None) -> float | None:
    """Return the multiple of the common factor that a group takes; None for opacities.

    The image is linear in the colours. Trainers set the rate of the higher bands to a twentieth of the constant band's,
    so the higher bands tolerate the longest steps. All views agree on the constant band, so it needs shorter steps.
    Without higher bands (SH degree 0) it takes the common factor; see `Division`. Positions, whose rate has fallen to a
    tenth when refinement begins, and scales tolerate longer steps. Opacities are not raised in refinement, except to
    recover from a reset: their rate is large already, and longer steps make them flicker.

    A group without any name is identified by its shape: [N, 1, 3] is the constant band, [N, K, 3] are higher bands,
    [N, 1] are opacities.

    Args:
        group: One of an optimizer's `param_groups`, which may have a name.
        name: Name of the optimizer, which stands for that of a group without one; None if unknown.
    """
    name = known_name(group.get("name", name))
    if name is not None:
        return None if name in OPACITIES else PART_BY_NAME.get(name, OTHERS)
    shapes = [tuple(param.shape[1:]) for param in group["params"]]
    if all(shape == (1,) for shape in shapes):
        return None
    if all(shape == (1, 3) for shape in shapes):
        return CONSTANT_BAND
    if all(len(shape) == 2 and shape[0] > 1 and shape[1] == 3 for shape in shapes):
        return HIGHER_BANDS
    return OTHERS


def rate_of_positions(optimizers: Iterable[torch.optim.Optimizer]) -> float:
    """Return the learning rate of the groups whose names say that they are positions; 0 without one."""
    groups = (group for optimizer in optimizers for group in optimizer.param_groups)
    return max((float(group["lr"]) for group in groups if known_name(group.get("name")) in POSITIONS), default=0.0)


class GroupInfo:
    """Facts about a group of parameters. They are found once, and hold while its parameters are the same tensors.

    Args:
        group: One of an optimizer's `param_groups`.
        name: Name of the optimizer, if its groups have no names; None if unknown.

    Attributes:
        group: The argument.
        part: Multiple of the common factor; see `group_part`.
        first: The parameter of a group that has only one; else None.
        positions: Parameters that may be positions [N, 3].
        named_positions: Whether the name says that they are positions.
        named_scales: Whether the name says that they are scales.
        scales: The only parameter of a group of scales, if it has up to three for each Gaussian; else None.
        no_bands: Whether it is the group of higher bands in a model that has none: [N, 0, 3].
        betas: The trainer's betas when `shorter` was called last.
        short: The betas that `shorter` returned then.
    """

    __slots__ = (
        "_known",
        "_params",
        "_shaped",
        "betas",
        "first",
        "group",
        "named_positions",
        "named_scales",
        "no_bands",
        "part",
        "positions",
        "scales",
        "short",
    )

    def __init__(self, group: dict[str, Any], name: str | None) -> None:
        self.group = group
        self.part = group_part(group, name)
        self._params: list[Tensor] = list(group["params"])
        self.first = self._params[0] if len(self._params) == 1 else None
        known = known_name(group.get("name", name))
        self._known = known is not None
        shapes = [tuple(param.shape[1:]) for param in self._params]
        # Inria's exposures step before the positions, so their rows cannot be compared. Groups with names belong to the
        # model, even if their shapes are unusual, as those of anchors are.
        self._shaped = all(shape in GAUSSIAN_SHAPES or (len(shape) == 2 and shape[1] == 3) for shape in shapes)
        self.named_positions = known in POSITIONS
        self.named_scales = known in SCALES
        self.scales = self.first if self.named_scales and shapes[0] in ((1,), (2,), (3,)) else None
        self.no_bands = bool(shapes) and all(shape == (0, 3) for shape in shapes)
        may_be = self._params if known is None or known in POSITIONS else []
        self.positions = [param for param in may_be if param.ndim == 2 and param.shape[1] == 3]
        self.betas: Any = None
        self.short: Any = None

    def fits(self, now: list[Tensor]) -> bool:
        """Whether `now`, the group's present parameters, are the tensors that these facts are about."""
        return len(now) == len(self._params) and all(map(_same, now, self._params))

    def of_gaussians(self, rows: int) -> bool:
        """Whether all parameters have a row for each of `rows` Gaussians; 0 if the number is not known."""
        if not rows:
            return self._known or self._shaped
        if self.first is not None:
            shape = self.first.shape
            return bool(shape) and shape[0] == rows
        return all(param.shape[:1] == (rows,) for param in self._params)

    @property
    def rate(self) -> float:
        """The trainer's learning rate; 0 for a group without one."""
        return float(self.group.get("lr") or 0.0)

    def has_gradient(self) -> bool:
        """Whether a parameter has a gradient."""
        return any(param.grad is not None for param in self._params)

    def shorter(self, betas: Any) -> Any:
        """Return the betas of a longer step, given the trainer's."""
        first, squares, *others = betas
        self.betas, self.short = betas, (first, min(squares, SQUARES_KEPT), *others)
        return self.short


class ScaledGroup(NamedTuple):
    """How a group takes the factor on learning rates. It holds while the number of Gaussians stays the same.

    Attributes:
        group: One of an optimizer's `param_groups`.
        times: Multiple of the factor that the group takes.
        most: Bound on the factor, before it is multiplied.
        longer: Facts about the group if its steps are larger and have a smaller beta2; else None.
        highest: Bound on the learning rate that results.
        scales: The Gaussians' scales [N, 1 to 3], if the group holds them alone; else None. Anchors have six.
    """

    group: dict[str, Any]
    times: float
    most: float
    longer: GroupInfo | None
    highest: float = math.inf
    scales: Tensor | None = None

    def times_rate(self, factor: float, rate: Any) -> float:
        """Return the multiple of its learning rate that the group takes.

        Args:
            factor: Factor on learning rates.
            rate: The group's learning rate; None for a group without one. A tensor is read only if there is a bound.
        """
        times = self.times * (factor if factor < self.most else self.most)
        return times if self.highest == math.inf or not rate else min(times, self.highest / rate)


class GrowingParts(NamedTuple):
    """How some kinds of parameters share in longer steps while the scene grows.

    Attributes:
        opacities: Multiple of their rate that opacities take, at least 1.
        positions: Multiple of the common factor that positions take.
        scales: Multiple of the common factor that scales take; 0 if they keep their rate.
        opacities_remember: Whether opacities keep the trainer's beta2.
        highest_opacity_rate: Learning rate that longer steps of opacities do not exceed.
        only_higher_bands: Whether no steps are longer but those of the colours' higher bands.
        all_remember: Whether all parameters keep the trainer's beta2; see `needs.SELDOM_SHOWN`.
        bounded: Whether sizes are bounded; see `SizeBound`.
    """

    opacities: float
    positions: float
    scales: float = GEOMETRY
    opacities_remember: bool = False
    highest_opacity_rate: float = math.inf
    only_higher_bands: bool = False
    all_remember: bool = False
    bounded: bool = True

    def of(self, info: GroupInfo) -> float:
        """Return the multiple of the common factor that a group other than opacities takes; 0 if it keeps its rate."""
        assert info.part is not None
        if self.only_higher_bands and info.part != HIGHER_BANDS:
            return 0.0
        if info.named_scales:
            return self.scales
        return self.positions if info.named_positions else info.part

    def remembers(self, info: GroupInfo) -> bool:
        """Whether a group keeps the trainer's beta2."""
        return self.all_remember or (info.part is None and self.opacities_remember)

    def of_opacities(self, rate: float) -> float:
        """Return the multiple of their learning rate `rate` that opacities take."""
        return max(1.0, min(self.opacities, self.highest_opacity_rate / rate)) if rate > 0.0 else self.opacities


UNCHANGED = GrowingParts(1.0, 1.0)  # with a factor of 1, the trainer's own steps
ONLY_HIGHER_BANDS = GrowingParts(1.0, 1.0, only_higher_bands=True)


class Division(NamedTuple):
    """How groups share in the factor on learning rates, as far as it is the same for all optimizers.

    Attributes:
        rows: Number of Gaussians; 0 if it is not known. Only parameters with as many rows take larger steps.
        growing: While the scene grows, the parts of opacities and positions. Parameters without a row for each Gaussian
            then keep their rates. None in refinement, in which opacities are raised by `opacity_rate` alone.
        raised: Whether the factor is larger than 1 while the scene grows. True in refinement.
        opacity_rate: Least learning rate of opacities, if they must recover from their last reset; else 0.
        positions_rate: Largest learning rate of positions in refinement.
        constant_alone: Whether the colours have a constant band only.
    """

    rows: int
    growing: GrowingParts | None
    raised: bool
    opacity_rate: float = 0.0
    positions_rate: float = math.inf
    constant_alone: bool = False


class OptimizerInfo:
    """Facts about an optimizer. They hold while its groups have the same parameters.

    Args:
        optimizer: The optimizer.
        name: Name of the optimizer, if its groups have no names; None if unknown.

    Attributes:
        groups: Facts about each group.
        name: The argument.
        positions: Parameters that may be positions [N, 3].
        known_positions: Positions [N, 3], if a name says so, which tell the number of Gaussians; else None.
        opacities: The only parameter of a group of opacities; else None.
        no_bands: Whether a group tells that the colours have a constant band only.
        scaled: The groups that are scaled; see `divide`.
        division: The argument of `divide` that `scaled` was found for.
    """

    __slots__ = (
        "_only",
        "division",
        "groups",
        "known_positions",
        "name",
        "no_bands",
        "opacities",
        "positions",
        "scaled",
    )

    def __init__(self, optimizer: torch.optim.Optimizer, name: str | None) -> None:
        self.name = name
        self.groups = [GroupInfo(group, name) for group in optimizer.param_groups]
        self.positions = [param for group in self.groups for param in group.positions]
        named = [param for group in self.groups if group.named_positions for param in group.positions]
        self.known_positions = named[0] if len(named) == 1 else None
        self.opacities = next((info.first for info in self.groups if info.part is None), None)
        self.no_bands = any(group.no_bands for group in self.groups)
        self.scaled: list[ScaledGroup] = []
        self.division: Division | None = None
        self._only = self.groups[0] if len(self.groups) == 1 and self.groups[0].first is not None else None

    def fits(self, optimizer: torch.optim.Optimizer) -> bool:
        """Whether these facts still hold."""
        groups, only = optimizer.param_groups, self._only
        if only is not None and len(groups) == 1:  # as in most trainers
            now = groups[0]["params"]
            return groups[0] is only.group and len(now) == 1 and now[0] is only.first
        return len(groups) == len(self.groups) and all(map(_is_about, self.groups, groups))

    def divide(self, division: Division) -> None:
        """Find the groups that are scaled, and their shares."""
        self.division = division
        self.scaled = [one for info in self.groups if (one := _scaled(info, division)) is not None]


def _scaled(info: GroupInfo, division: Division) -> ScaledGroup | None:
    rows, growing, raised, opacity_rate, positions_rate, constant_alone = division
    if not info.of_gaussians(rows):
        return ScaledGroup(info.group, OTHERS_AT_MOST, 1.0, None) if growing is None else None
    longer = None if growing is not None and growing.remembers(info) else info
    if info.part is None:
        rate = info.rate
        times = (1.0 if growing is None else growing.of_opacities(rate)) * _recovering(rate, opacity_rate)
        if growing is None or times > 1.0 or (raised and not growing.only_higher_bands):
            return ScaledGroup(info.group, times, 1.0, longer)
        return None
    if not raised:
        return None
    part = info.part if growing is None else growing.of(info)
    if part == 0.0:
        return None
    if part == CONSTANT_BAND and constant_alone:
        part = OTHERS
    highest = positions_rate if growing is None and info.named_positions else math.inf
    bounded = growing is None or growing.bounded
    return ScaledGroup(info.group, part, math.inf, longer, highest, info.scales if bounded else None)


def _recovering(rate: float, least: float) -> float:
    """Return the factor on the rate of opacities that must recover; see `needs.opacity_rate`."""
    return max(min(least, HIGHEST_RECOVERING_RATE) / rate, 1.0) if rate > 0.0 else 1.0


def _is_about(info: GroupInfo, group: dict[str, Any]) -> bool:
    return info.group is group and info.fits(group["params"])


def _same(one: Any, other: Any) -> bool:
    return one is other
