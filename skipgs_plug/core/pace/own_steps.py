"""Steps of an optimizer that is not one of PyTorch's: finds out which settings they read."""

from __future__ import annotations

import contextlib
from typing import Any

import torch

from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pace.parts import ScaledGroup
from skipgs_plug.core.pace.step_reads import LiteralBetas, WatchedGroup, shorter_memory, unwatch, watch


class OwnSteps:
    """Judges which settings the first longer step reads, and makes up for a beta2 that steps do not read."""

    def __init__(self) -> None:
        self._judged = False
        self._longer: list[dict[str, Any]] = []  # groups with a gradient and a changed rate, until the step is judged
        self._watched: list[WatchedGroup] = []  # copies that replace all groups during the first longer step
        self._literal: LiteralBetas | None = None  # replaces betas that a step passes as literal numbers
        self._memory_stays = False  # whether a step has a beta2 that cannot be changed from outside
        self._until_end = contextlib.ExitStack()

    def begin(
        self,
        optimizer: torch.optim.Optimizer,
        scaled: list[ScaledGroup],
        before: list[tuple[dict[str, Any], Any, Any]],
        factor: float,
    ) -> None:
        """Watch which settings the first longer step reads, and replace literal betas that it passes on.

        Args:
            optimizer: The optimizer, whose settings have been changed.
            scaled: The groups that are scaled.
            before: The same groups, each with the trainer's rate and betas.
            factor: Factor on learning rates.
        """
        for one, (group, rate, betas) in zip(scaled, before, strict=True):
            if one.longer is None:
                continue
            times = one.times_rate(factor, rate)
            if self._memory_stays and betas is not None:
                times = max(min(times, 1.0), times * shorter_memory(betas))
                if rate is not None:
                    group["lr"] = rate * times
            if not self._judged and times != 1.0 and one.longer.has_gradient():
                self._longer.append(group)
        if self._longer:
            with_betas = next((betas for _, _, betas in before if betas is not None), None)
            self._literal = None if with_betas is None else LiteralBetas(optimizer, with_betas)
            self._watched = watch(optimizer.param_groups)
            self._until_end.callback(unwatch, optimizer.param_groups)
        if self._literal is not None:
            self._until_end.enter_context(self._literal.in_place())

    def shares_groups(self, groups: list[dict[str, Any]]) -> bool:
        """Whether these groups of another optimizer, or the copies in their place, are watched here."""
        own = {id(group) for group in groups}
        return any(id(one) in own or id(one.group) in own for one in self._watched)

    def stop_watching(self) -> None:
        """Do not judge this step: another optimizer uses its groups inside it."""
        self._until_end.close()
        self._watched, self._literal = [], None

    def put_back(self) -> None:
        """Restore groups and literal betas."""
        self._until_end.close()

    def drop(self) -> None:
        """Forget a step that raised."""
        self._watched = []
        self._longer.clear()

    def end(self, optimizer: torch.optim.Optimizer) -> bool:
        """Judge a watched step by the settings that it read; return whether steps are known to read all of them.

        Raises:
            SkipGSError: It did not read the learning rates, so larger steps have no effect.
        """
        if not self._watched:
            return False
        longer = [group for group in self._watched if any(group.group is one for one in self._longer)]
        self._judged, self._watched = True, []
        self._longer.clear()
        kind = type(optimizer).__name__
        if any("lr" not in group.read or "lr" not in group for group in longer):
            raise SkipGSError(
                f"Steps of {kind} do not read the lr of its param_groups, so they are not larger; let them read it, or "
                "give compensate=False."
            )
        fixed = [group for group in longer if "betas" in group and "betas" not in group.read]
        if fixed and self._literal is not None and self._literal.replaced:
            return False
        self._literal, self._memory_stays = None, bool(fixed)
        if fixed:
            bound = shorter_memory(fixed[0].group["betas"])
            caution(
                f"Steps of {kind} do not read the betas of its param_groups, so its beta2 cannot be lowered; "
                f"its learning rates are raised {bound:.2f} times as far instead."
            )
        return not fixed
