"""Steps of one optimizer with changed settings: restores the trainer's settings, and judges which settings it reads."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import torch
from torch.utils.hooks import RemovableHandle

from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pace.parts import OptimizerInfo
from skipgs_plug.core.pace.step_reads import LiteralBetas, WatchedGroup, is_torchs, shorter_memory, unwatch, watch

# Largest beta2 of Adam during a longer step. The gradient of a single view can move a parameter by its rate divided by
# the root of 1 - beta2: 32 times the rate at the usual 0.999, which is too far with larger rates, 7 times at 0.98.
SQUARES_KEPT = 0.98


class OptimizerSteps:
    """Facts about the groups of one optimizer, and the trainer's settings while one of its steps is under way.

    Args:
        optimizer: The optimizer.
        name: Name of the optimizer, if its groups have no names; None if unknown.
        under_way: Steps of all optimizers that have begun and not ended, outermost first.
        failed: Receives errors at the end of a step, and raises them or releases the gate.

    Attributes:
        info: Facts about the groups.
        handles: Handles of the hooks on the optimizer.
        gone: Weak reference that removes this object together with the optimizer.
        depth: Number of nested calls of the optimizer's `step`.
        before: Groups with changed settings, each with the trainer's rate and betas; None for a setting that the group
            does not have.
        longer: Groups with a gradient and a changed rate; filled until the optimizer is judged.
        watched: Copies that replace all groups during the first longer step of an optimizer that is not PyTorch's.
        judged: Whether it is known which settings a step reads.
        literal: Replaces betas that a step passes as literal numbers; None if it passes none.
        memory_stays: Whether a step has a beta2 that cannot be changed from outside.
    """

    __slots__ = (
        *("_failed", "_under_way", "_until_end", "before", "depth", "info", "gone", "handles", "judged"),
        *("literal", "longer", "memory_stays", "watched"),
    )

    def __init__(
        self,
        optimizer: torch.optim.Optimizer,
        name: str | None,
        under_way: list[OptimizerSteps],
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
        self.put_back()
        if self.watched is not None:
            self.judge(optimizer)

    def drop(self) -> None:
        """Forget a step that raised, and restore the trainer's settings."""
        self.depth = 0
        self.put_back()
        self.watched = None
        self.longer.clear()

    def prepare(self, optimizer: torch.optim.Optimizer) -> None:
        """Watch which settings the first longer step reads, and replace literal betas that it passes on."""
        self._until_end = contextlib.ExitStack()
        if not self.judged:
            betas = next((betas for _, _, betas in self.before if betas is not None), None)
            self.literal = None if betas is None else LiteralBetas(optimizer, betas, SQUARES_KEPT)
            self.watched = watch(optimizer.param_groups)
            self._until_end.callback(unwatch, optimizer.param_groups)
        if self.literal is not None:
            self._until_end.enter_context(self.literal.in_place())

    def stop_watching(self) -> None:
        """Do not judge this step: another optimizer uses its groups inside it."""
        if self._until_end is not None:
            self._until_end.close()
        self.watched = self.literal = None

    def put_back(self) -> None:
        """Restore the trainer's settings, once: values that the trainer sets later stay."""
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
        """Judge the watched step, which has ended, by the settings that it read.

        Raises:
            SkipGSError: It did not read the learning rates, so larger steps have no effect.
        """
        watched, self.watched = self.watched or [], None
        longer = [group for group in watched if any(group.group is one for one in self.longer)]
        self.judged = True
        self.longer.clear()
        kind = type(optimizer).__name__
        if any("lr" not in group.read or "lr" not in group for group in longer):
            raise SkipGSError(
                f"Steps of {kind} do not read the lr of its param_groups, so they are not larger; let them read it, or "
                "give compensate=False."
            )
        fixed = [group for group in longer if "betas" in group and "betas" not in group.read]
        if fixed and self.literal is not None and self.literal.replaced:
            return
        self.literal, self.memory_stays = None, bool(fixed)
        if fixed:
            bound = shorter_memory(fixed[0].group["betas"], SQUARES_KEPT)
            caution(
                f"Steps of {kind} do not read the betas of its param_groups, so its beta2 cannot be lowered; "
                f"its learning rates are raised {bound:.2f} times as far instead."
            )
