"""Optimizer steps of a gated loop: only with a pending gradient, and accumulated when asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import torch

from skipgs_plug.core.accumulate import (
    StepAccumulator,
    gradient_norm,
    has_pending_gradient,
    parameters_of,
)
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.errors import SkipGSError

if TYPE_CHECKING:
    from skipgs_plug.core.hooks import Hooks


class Iteration(Protocol):
    """What is known of the present iteration, as in `OptimizerSteps.step`."""

    ran: bool

    @property
    def step_at_once(self) -> bool: ...


class OptimizerSteps:
    """Decides in each iteration whether optimizers step.

    Attributes:
        accumulator: the window of gradients, in use when `step_mode` is "adaptive_norm".
    """

    def __init__(self, config: SkipConfig) -> None:
        self.accumulating = config.enabled and config.step_mode == "adaptive_norm"
        self._always = not config.enabled
        self.accumulator = StepAccumulator(config.step_trigger)
        self._answer: bool | None = None  # of the present iteration
        self._may_zero = True
        self._attached: dict[int, torch.optim.Optimizer] = {}

    def begin_iteration(self) -> None:
        """Forget the previous iteration's answer."""
        self._answer = None

    def step(self, optimizers: list[torch.optim.Optimizer], args: tuple[Any, ...], ran: bool, at_once: bool) -> bool:
        """Step those optimizers that have a pending gradient; True when one was stepped.

        Args:
            optimizers: All that step together.
            args: Passed to each `step`.
            ran: A real backward ran in this iteration.
            at_once: No accumulation in this iteration (warm-up, pause).
        """
        if self.accumulating and not self._due(optimizers, ran, at_once):
            return False
        stepped = False
        for optimizer in optimizers:
            if self._always or has_pending_gradient(optimizer):
                optimizer.step(*args)
                stepped = True
        return stepped

    def attach(
        self,
        hooks: Hooks,
        optimizers: Callable[[], Iterable[torch.optim.Optimizer]],
        iteration: Iteration,
    ) -> None:
        """Make the trainer's own `step` and `zero_grad` calls wait for the window.

        Called in every iteration, since trainers rebuild optimizers.

        Args:
            hooks: Where replaced methods are listed.
            optimizers: Gives all optimizers of the trainer.
            iteration: What happened in the present iteration.

        Raises:
            SkipGSError: The adapter names no optimizers.
        """
        present = list(optimizers())
        if not present:
            raise SkipGSError("This trainer keeps its own schedule of optimizer steps; leave step_mode at 'off'.")

        def around_step(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            ran, at_once = iteration.ran, iteration.step_at_once
            masked = bool(args) and isinstance(args[0], torch.Tensor) and args[0].dtype == torch.bool
            if masked and ran and self._answer is None:
                self.accumulator.see(args[0])
            if not self._due(list(optimizers()), ran, at_once):
                return None
            if masked:
                args = (self.accumulator.visible, *args[1:])
            return original(*args, **kwargs)

        def around_zero(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            return original(*args, **kwargs) if self._may_zero else None

        for optimizer in present:
            if id(optimizer) not in self._attached:
                self._attached[id(optimizer)] = optimizer  # kept, so that no id is used again
                hooks.wrap(optimizer, "step", around_step)
                hooks.wrap(optimizer, "zero_grad", around_zero)

    def _due(self, optimizers: list[torch.optim.Optimizer], ran: bool, at_once: bool) -> bool:
        """The one answer for all optimizers of this iteration."""
        if self._answer is None:
            if ran:
                self.accumulator.observe(gradient_norm(parameters_of(optimizers)))
            self._answer = ran and (at_once or self.accumulator.due())
            self._may_zero = self._answer
            if self._answer:
                self.accumulator.reset()
        return self._answer


def listed(optimizer: Any) -> list[torch.optim.Optimizer]:
    """Return one optimizer, a collection or a dict of them as a list."""
    if isinstance(optimizer, Mapping):
        return list(optimizer.values())
    if isinstance(optimizer, (list, tuple)):
        return list(optimizer)
    return [optimizer]
