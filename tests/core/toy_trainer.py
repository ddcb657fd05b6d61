"""A trainer of twenty lines, and its adapter."""

from __future__ import annotations

import torch

from skipgs_plug import SkipGate
from skipgs_plug.adapters import AbstractAdapter, TrainerInfo


class ToyTrainer:
    """Ten views, densification until iteration 20, a prune at 60."""

    def __init__(self, steps: int = 100, backwards: int = 1, render: bool = True) -> None:
        self.parameter = torch.nn.Parameter(torch.ones(3))
        self.optimizer = torch.optim.Adam([self.parameter], lr=0.05)
        self.steps, self.backwards, self.rendering = steps, backwards, render
        self.noise = 0

    def begin(self, step: int) -> None: ...

    def render(self, view: str) -> torch.Tensor:
        return self.parameter * (1.0 + 0.1 * int(view[1:]))

    def measure(self, step: int) -> None: ...

    def prune(self) -> None: ...

    def add_noise(self) -> None:
        self.noise += 1

    def train(self) -> None:
        for step in range(self.steps):
            self.begin(step)
            image = self.render(f"v{step % 10}") if self.rendering else self.parameter
            loss = (image**2).mean()
            self.measure(step)
            for _ in range(self.backwards):
                loss.backward(retain_graph=True)
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)
            self.add_noise()
            if step == 60:
                self.prune()


class Toy(AbstractAdapter):
    name = "toy"
    checked = "ToyTrainer 1.0"
    hurried = False

    @classmethod
    def matches(cls, trainer) -> bool:
        return isinstance(trainer, ToyTrainer)

    def attach(self, hooks) -> None:
        trainer = self.trainer
        hooks.before(trainer, "begin", hooks.iteration)
        hooks.before(trainer, "render", hooks.view)
        hooks.events(trainer, "prune")
        hooks.suppress_on_skip(trainer, "add_noise")
        hooks.gate_tensor_backward("train")
        if not self.hurried:
            hooks.ready(
                TrainerInfo(20, view_names=[f"v{i}" for i in range(10)], defaults={"warmup": 12, "pause_iters": 15})
            )

    def must_run(self, step: int) -> bool:
        return step == 45

    def optimizers(self):
        return [self.trainer.optimizer]


def attach(trainer: ToyTrainer, **settings) -> SkipGate:
    return SkipGate(trainer, adapter=Toy(trainer), **settings)


def plain(trainer: ToyTrainer) -> bool:
    return not {"begin", "render", "prune", "add_noise"} & set(vars(trainer)) and not hasattr(
        torch.Tensor.backward, "__skipgs_plug__"
    )
