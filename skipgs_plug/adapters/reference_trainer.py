"""Our own trainer, `skipgs_plug.trainer.Trainer`: its backward is a method with view and step."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch

from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.gsplat_strategy import iterations_that_run, strategy_events
from skipgs_plug.core.clock import Times
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.half_size import can_be_halved, in_unit_range, some_of
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.pause import MIN_PAUSE_ITERS
from skipgs_plug.core.trainer_info import Densification, TrainerInfo

FULL_SCHEDULE = 30_000  # iterations of the schedule that the default settings of gate and trainer suit


class ReferenceTrainer(AbstractAdapter):
    """Gates the instance's `backward(loss, view, step)`. Snapshots and checkpoints hold the state of the gate."""

    name = "reference"
    checked = "the trainer of this package (itself, on the CPU, by the tests)"
    project = "this package's own trainer"
    gated = "From the end of densification on."
    with_share = "By visits; with MCMC, all events are kept."
    left_alone = "Its snapshots and checkpoints hold the state of the gate."

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        return any(c.__module__.startswith("skipgs_plug.trainer") for c in type(trainer).__mro__)

    def attach(self, hooks: Hooks) -> None:
        trainer = self.trainer
        if "skipgs" in trainer.registered:
            raise SkipGSError("This trainer is gated already: detach() the other gate first.")

        def gated(original: Callable[..., None], loss: torch.Tensor, view: str, step: int) -> None:
            hooks.iteration(step)
            hooks.backward(loss, lambda: original(loss, view, step), view)

        def always_run(numbers: range) -> Iterable[int]:
            return iterations_that_run(trainer.strategy, numbers, trainer.resets_opacities)

        hooks.wrap(trainer, "backward", gated)
        hooks.own_loop(trainer, "iterations", always=always_run)
        views = trainer.scene.train
        halves = hooks.may_halve and all(can_be_halved(view.height, view.width) for view in views)
        if halves:
            hooks.wrap(trainer, "at_half_size", lambda original: hooks.at_half_size)
        n_views = len(trainer.view_names)
        scale = trainer.config.schedule / FULL_SCHEDULE
        hooks.ready(
            TrainerInfo(
                trainer.refine_stop_iter,
                view_names=trainer.view_names,
                max_steps=trainer.max_steps - 1,
                densification=_densification(trainer),
                photographs=(lambda: (in_unit_range(views[i].image) for i in some_of(n_views))) if halves else None,
                defaults={
                    "warmup": max(2 * n_views, round(SkipConfig.warmup * scale)),
                    "pause_iters": max(n_views, round(MIN_PAUSE_ITERS * scale)),
                },
            )
        )
        trainer.register_state("skipgs", hooks.state)
        hooks.on_detach("Trainer.registered['skipgs']", lambda: trainer.registered.pop("skipgs", None))

    def optimizers(self) -> Iterable[torch.optim.Optimizer]:
        return self.trainer.all_optimizers

    def timing(self) -> Times | None:
        wall, processor = self.trainer.clock.wall, self.trainer.clock.processor
        return Times(wall.total, wall.post, processor.total, processor.post)


def _densification(trainer: Any) -> Densification | None:
    """Events of the trainer's strategy; MCMC adds a constant share of Gaussians per event, so all are kept."""
    mcmc = trainer.mcmc
    if mcmc is None:
        return strategy_events(trainer.strategy, trainer.resets_opacities)
    return Densification(numbers=lambda numbers: filter(mcmc.moves, numbers), needs="nothing", resets=False)
