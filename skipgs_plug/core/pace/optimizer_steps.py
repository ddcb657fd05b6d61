"""Steps of one optimizer with changed settings: changes learning rates and betas, and restores the trainer's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils.hooks import RemovableHandle

from skipgs_plug.core.pace.own_steps import OwnSteps
from skipgs_plug.core.pace.parts import OptimizerInfo, ScaledGroup
from skipgs_plug.core.pace.size_bound import SizeBound
from skipgs_plug.core.pace.step_reads import is_torchs


class OptimizerSteps:
    """Facts about the groups of one optimizer, and the trainer's settings while one of its steps is under way.

    Args:
        optimizer: The optimizer.
        name: Name of the optimizer, if its groups have no names; None if unknown.
        under_way: Steps of all optimizers that have begun and not ended, outermost first.
        sizes: Bounds longer steps of scales.
        failed: Receives errors at the end of a step, and raises them or releases the gate.

    Attributes:
        info: Facts about the groups.
        handles: Handles of the hooks on the optimizer.
        gone: Weak reference that removes this object together with the optimizer.
        depth: Number of nested calls of the optimizer's `step`.
        before: Groups with changed settings, each with the trainer's rate and betas; None for a setting that the group
            does not have.
        own: Finds out which settings a step reads, if it is not one of PyTorch's; None if it reads all of them.
    """

    __slots__ = ("_failed", "_grown", "_sizes", "_under_way", "before", "depth", "gone", "handles", "info", "own")

    def __init__(
        self,
        optimizer: torch.optim.Optimizer,
        name: str | None,
        under_way: list[OptimizerSteps],
        sizes: SizeBound,
        failed: Callable[[Exception], None],
    ) -> None:
        self.info = OptimizerInfo(optimizer, name)
        self.handles: list[RemovableHandle] = []
        self.gone: Any = None
        self._under_way, self._sizes, self._failed = under_way, sizes, failed
        # Scales that take a longer step, their values before it, and how many times as long it is.
        self._grown: list[tuple[Tensor, Tensor, float]] = []
        self.depth = 0
        self.before: list[tuple[dict[str, Any], Any, Any]] = []
        self.own = None if is_torchs(optimizer) else OwnSteps()

    def begin(self, optimizer: torch.optim.Optimizer, scaled: list[ScaledGroup], factor: float) -> None:
        """Change the settings for the step that begins.

        Args:
            optimizer: The optimizer.
            scaled: The groups that are scaled.
            factor: Factor on learning rates.
        """
        self._under_way.append(self)
        before = self.before
        for one in scaled:
            group, longer = one.group, one.longer
            rate, betas = group.get("lr"), group.get("betas")
            before.append((group, rate, betas))
            if rate is not None:
                times = one.times_rate(factor, rate)
                group["lr"] = rate * times
                if one.scales is not None and times > 1.0 and self._sizes.measured:
                    self._grown.append((one.scales, one.scales.detach().clone(), times))
            if betas is not None and longer is not None:
                group["betas"] = longer.short if betas is longer.betas else longer.shorter(betas)
        if self.own is not None:
            self.own.begin(optimizer, scaled, before, factor)

    def after_step(self, optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        """Hook of PyTorch: a step has ended."""
        if self.depth:
            self.depth -= 1
            if self.depth == 0:
                try:
                    self.end(optimizer)
                except Exception as error:
                    self._failed(error)

    def end(self, optimizer: torch.optim.Optimizer) -> None:
        """Restore the trainer's settings before other code reads them, and judge a watched step."""
        self._under_way.remove(self)
        grown, self._grown = self._grown, []
        self.put_back()
        for scales, before, times in grown:
            self._sizes.shorten(scales, before, times)
        if self.own is not None and self.own.end(optimizer):
            self.own = None

    def drop(self) -> None:
        """Forget a step that raised, and restore the trainer's settings."""
        self.depth = 0
        self.put_back()
        if self.own is not None:
            self.own.drop()

    def put_back(self) -> None:
        """Restore the trainer's settings, once: values that the trainer sets later stay."""
        for group, rate, betas in self.before:
            if rate is not None:
                group["lr"] = rate
            if betas is not None:
                group["betas"] = betas
        self.before.clear()
        self._grown.clear()
        if self.own is not None:
            self.own.put_back()
