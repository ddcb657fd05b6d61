"""Optimizer steps of a gated loop: only with a pending gradient, and accumulated when asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch

from skipgs_plug.core.accumulate import (
    StepAccumulator,
    gradient_norm,
    has_pending_gradient,
    parameters_of,
)
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.intercept import Wrap
from skipgs_plug.core.iteration import Iteration


class OptimizerSteps:
    """Decides in each iteration whether optimizers step.

    Args:
        config: Settings of the gate.
        iteration: The present iteration.

    Attributes:
        accumulator: the window of gradients, in use when `step_mode` is "adaptive_norm".
    """

    def __init__(self, config: SkipConfig, iteration: Iteration) -> None:
        self.accumulating = config.enabled and config.step_mode == "adaptive_norm"
        self._always = not config.enabled
        self.accumulator = StepAccumulator(config.step_trigger)
        self._iteration = iteration
        self._may_zero = True
        self._attached: dict[int, torch.optim.Optimizer] = {}

    def step(self, optimizers: list[torch.optim.Optimizer], args: tuple[Any, ...]) -> bool:
        """Step those optimizers that have a pending gradient; True when one was stepped.

        Args:
            optimizers: All that step together.
            args: Passed to each `step`.
        """
        if self.accumulating and not self._due(optimizers):
            return False
        stepped = False
        for optimizer in optimizers:
            if self._always or has_pending_gradient(optimizer):
                optimizer.step(*args)
                stepped = True
        return stepped

    def attach(self, wrap: Wrap, optimizers: Callable[[], Iterable[torch.optim.Optimizer]]) -> None:
        """Make the trainer's own `step` and `zero_grad` calls wait for the window.

        Called in every iteration, since trainers rebuild optimizers.

        Args:
            wrap: Replaces a method, as `Patches.wrap` does.
            optimizers: Gives all optimizers of the trainer.

        Raises:
            SkipGSError: The adapter names no optimizers.
        """
        present = list(optimizers())
        if not present:
            raise SkipGSError("This trainer keeps its own schedule of optimizer steps; leave step_mode at 'off'.")

        def around_step(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            masked = bool(args) and isinstance(args[0], torch.Tensor) and args[0].dtype == torch.bool
            if masked and self._iteration.ran and self._iteration.due is None:
                self.accumulator.see(args[0])
            if not self._due(list(optimizers())):
                return None
            if masked:
                args = (self.accumulator.visible, *args[1:])
            return original(*args, **kwargs)

        def around_zero(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            return original(*args, **kwargs) if self._may_zero else None

        for optimizer in present:
            if id(optimizer) not in self._attached:
                self._attached[id(optimizer)] = optimizer  # kept, so that no id is used again
                wrap(optimizer, "step", around_step)
                wrap(optimizer, "zero_grad", around_zero)

    def _due(self, optimizers: list[torch.optim.Optimizer]) -> bool:
        """The one answer for all optimizers of this iteration."""
        now = self._iteration
        if now.due is None:
            if now.ran:
                self.accumulator.observe(gradient_norm(parameters_of(optimizers)))
            now.due = self._may_zero = now.ran and (now.step_at_once or self.accumulator.due())
            if now.due:
                self.accumulator.reset()
        return now.due


def listed(optimizer: Any) -> list[torch.optim.Optimizer]:
    """Return one optimizer, a collection or a dict of them as a list."""
    if isinstance(optimizer, Mapping):
        return list(optimizer.values())
    if isinstance(optimizer, (list, tuple)):
        return list(optimizer)
    return [optimizer]
