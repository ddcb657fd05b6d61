"""A tiny training problem: views that pull one parameter vector each their own way."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest
import torch


class TinyLoop:
    """Five views, one parameter, Adam; the loop every gate test drives."""

    def __init__(self, n_views: int = 5, seed: int = 0) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.parameter = torch.nn.Parameter(torch.randn(4, generator=generator))
        self.targets = torch.randn(n_views, 4, generator=generator)
        self.optimizer = torch.optim.Adam([self.parameter], lr=0.02)
        self.order = random.Random(seed)
        self.poisoned: set[int] = set()

    def loss(self, step: int) -> tuple[torch.Tensor, str]:
        """Loss of the view that this iteration draws, and the view's name."""
        view = self.order.randrange(len(self.targets))
        loss = ((self.parameter - self.targets[view]) ** 2).mean()
        if step in self.poisoned:
            loss = loss * float("nan")
        return loss, f"images/{view}.png"

    def train(self, steps: int, gate: Any = None, first: int = 0) -> list[torch.Tensor]:
        """Run iterations and return the parameter after each."""
        history = []
        for step in range(first, first + steps):
            loss, view = self.loss(step)
            if gate is None:
                loss.backward()
                self.optimizer.step()
                self.optimizer.zero_grad(set_to_none=True)
            else:
                gate.backward(loss, view=view, step=step)
                if gate.step(self.optimizer):
                    self.optimizer.zero_grad(set_to_none=True)
                gate.update()
            history.append(self.parameter.detach().clone())
        return history


@pytest.fixture
def tiny_loop() -> Callable[..., TinyLoop]:
    """Makes a fresh loop; the same arguments give the same training."""
    return TinyLoop
