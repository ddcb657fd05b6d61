"""What a group of parameters takes of the factor on learning rates, and facts about it that stay from step to step."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from skipgs_plug.core.pace.visibility import POSITIONS

# What a group of parameters takes of the factor that is meant for all. In refinement opacities are never raised.
HIGHER_BANDS, GEOMETRY, OTHERS, CONSTANT_BAND = 4.0, 2.0, 1.0, 0.5
NAMED = {
    **dict.fromkeys(("f_rest", "shN", "features_rest"), HIGHER_BANDS),
    **dict.fromkeys(("f_dc", "sh0", "features_dc"), CONSTANT_BAND),
    **dict.fromkeys(("xyz", "means", "scaling", "scales"), GEOMETRY),
}
OPACITIES = ("opacity", "opacities")
# Greatest factor on the rate of opacities while the scene grows. They must come back from each reset in the few
# iterations that run, and beyond it they flicker: on bonsai (7,000 iterations) 1, 2 and 4 times the rate end at 30.47,
# 30.49 and 30.19 dB.
OPACITIES_GROWING = 2.0
OTHERS_AT_MOST = 0.25  # of the trainer's rate, at most, for what has no row for each Gaussian
GAUSSIAN_SHAPES = ((), (1,), (2,), (3,), (4,))  # shapes of its parameters beside colours [K, 3]


def group_part(group: dict[str, Any], name: str | None = None) -> float | None:
    """Return how many times the factor of all a group takes; None for opacities, which are never raised.

    The image is linear in the colours, so their higher bands, whose rate trainers set to a twentieth of the constant
    band's, bear the longest steps, and the constant band, which all views agree on, needs shorter ones. Positions,
    whose rate has fallen to a tenth when refinement begins, and scales bear longer steps. Opacities are never raised:
    their rate is large as it is, and steps beyond it flicker. All are known by the group's name, or else the `name` of
    its optimizer; without either by shape: [N, 1, 3] is the constant band, [N, K, 3] higher ones, [N, 1] opacities.
    """
    name = group.get("name", name)
    if name is not None:
        return None if name in OPACITIES else NAMED.get(name, OTHERS)
    shapes = [tuple(param.shape[1:]) for param in group["params"]]
    if all(shape == (1,) for shape in shapes):
        return None
    if all(shape == (1, 3) for shape in shapes):
        return CONSTANT_BAND
    if all(len(shape) == 2 and shape[0] > 1 and shape[1] == 3 for shape in shapes):
        return HIGHER_BANDS
    return OTHERS


class GroupInfo:
    """Facts about a group of parameters, found once and valid while its parameters are the same tensors.

    Args:
        group: One of an optimizer's `param_groups`.
        name: Of its optimizer, where groups have no names; None if unknown.

    Attributes:
        group: as given.
        part: as `group_part`.
        first: its parameter, where it has one alone; else None.
        positions: parameters that may be positions [N, 3].
        betas: of the trainer, when they were made shorter last.
        short: what they were made then.
    """

    __slots__ = ("_known", "_params", "_shaped", "betas", "first", "group", "part", "positions", "short")

    def __init__(self, group: dict[str, Any], name: str | None) -> None:
        self.group = group
        self.part = group_part(group, name)
        self._params: list[Tensor] = list(group["params"])
        self.first = self._params[0] if len(self._params) == 1 else None
        known = group.get("name", name)
        self._known = known is not None
        shapes = [tuple(param.shape[1:]) for param in self._params]
        # Inria's exposures step before the positions do. Groups with names are a model's, of anchors for example.
        self._shaped = all(shape in GAUSSIAN_SHAPES or (len(shape) == 2 and shape[1] == 3) for shape in shapes)
        may_be = self._params if known is None or known in POSITIONS else []
        self.positions = [param for param in may_be if param.ndim == 2 and param.shape[1] == 3]
        self.betas: Any = None  # of the trainer, for which `_short` was made
        self.short: Any = None

    def fits(self, now: list[Tensor]) -> bool:
        """Whether the group's parameters `now` are those that these facts are about."""
        return len(now) == len(self._params) and all(map(_same, now, self._params))

    def of_gaussians(self, rows: int) -> bool:
        """Whether all its parameters have a row for each of `rows` Gaussians; 0 where the number is not known."""
        if not rows:
            return self._known or self._shaped
        if self.first is not None:
            shape = self.first.shape
            return bool(shape) and shape[0] == rows
        return all(param.shape[:1] == (rows,) for param in self._params)

    def has_gradient(self) -> bool:
        """Whether a parameter has a gradient."""
        return any(param.grad is not None for param in self._params)

    def shorter(self, betas: Any, second: float) -> Any:
        """Return `betas` with the second at most `second`."""
        first, squares, *others = betas
        self.betas, self.short = betas, (first, min(squares, second), *others)
        return self.short


class Share(NamedTuple):
    """What a group takes of the factor on learning rates, as long as the number of Gaussians stays.

    Attributes:
        group: one of an optimizer's `param_groups`.
        times: of the factor.
        most: greatest factor that it takes this of.
        longer: facts about the group if its steps are larger; None if they are at most as long as the trainer's.
    """

    group: dict[str, Any]
    times: float
    most: float
    longer: GroupInfo | None


class OptimizerInfo:
    """Facts about an optimizer, valid while its groups hold the same parameters.

    Args:
        optimizer: They are about this one.
        name: Of it, where its groups have none; None if unknown.

    Attributes:
        groups: of each of its groups.
        name: as given.
        positions: parameters that may be positions [N, 3].
        shares: of its groups, see `divide`.
        rows, growing: The arguments of `divide` that `shares` were found for.
    """

    __slots__ = ("_only", "groups", "growing", "name", "positions", "rows", "shares")

    def __init__(self, optimizer: torch.optim.Optimizer, name: str | None) -> None:
        self.name = name
        self.groups = [GroupInfo(group, name) for group in optimizer.param_groups]
        self.positions = [param for group in self.groups for param in group.positions]
        self.shares: list[Share] = []
        self.rows: int | None = None
        self.growing = False
        self._only = self.groups[0] if len(self.groups) == 1 and self.groups[0].first is not None else None

    def fits(self, optimizer: torch.optim.Optimizer) -> bool:
        """Whether they still hold."""
        groups, only = optimizer.param_groups, self._only
        if only is not None and len(groups) == 1:  # as in most trainers
            now = groups[0]["params"]
            return groups[0] is only.group and len(now) == 1 and now[0] is only.first
        return len(groups) == len(self.groups) and all(map(_is_about, self.groups, groups))

    def divide(self, rows: int, growing: bool) -> None:
        """Find `shares` where there are `rows` Gaussians, 0 if their number is not known.

        Args:
            rows: Only what has a row for each Gaussian takes larger steps.
            growing: The scene still grows: everything else is left alone, and opacities take longer steps, too.
        """
        self.rows, self.growing = rows, growing
        self.shares = [share for one in self.groups if (share := _share(one, rows, growing)) is not None]


def _share(info: GroupInfo, rows: int, growing: bool) -> Share | None:
    if not info.of_gaussians(rows):
        return None if growing else Share(info.group, OTHERS_AT_MOST, 1.0, None)
    if info.part is None:
        return Share(info.group, 1.0, OPACITIES_GROWING if growing else 1.0, info)
    return Share(info.group, info.part, math.inf, info)


def _is_about(info: GroupInfo, group: dict[str, Any]) -> bool:
    return info.group is group and info.fits(group["params"])


def _same(one: Any, other: Any) -> bool:
    return one is other
