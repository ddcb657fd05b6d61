"""The first iterations of a run that leaves out what it can, and what they cost: a forecast is made of them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from skipgs_plug import SkipGate
from skipgs_plug.bench.memory import memory_meter
from skipgs_plug.trainer import Scene, TrainConfig, Trainer
from skipgs_plug.trainer.loop import Iteration

PILOT_STEPS = 7000  # length of the schedule whose first iterations are run


@dataclass(frozen=True)
class Sample:
    """One iteration that ran.

    Attributes:
        step: its number in the schedule of the pilot.
        gaussians: how many there were after it.
        seconds: of it.
    """

    step: int
    gaussians: int
    seconds: float


@dataclass(frozen=True)
class Pilot:
    """What was seen.

    Attributes:
        samples: the iterations that ran, in order.
        first_gaussians: how many there were before them.
        views: number of training views.
        shown: share of the Gaussians that a view shows; None if too few iterations ran to say.
        stop: iteration of the pilot's schedule with which densification ends.
        peak_memory: most bytes in use, of the process on the CPU, of PyTorch on a GPU; None where this is unknown.
    """

    samples: tuple[Sample, ...]
    first_gaussians: int
    views: int
    shown: float | None
    stop: int
    peak_memory: int | None


def run_pilot(
    config: TrainConfig, scene: Scene, seconds: float, by_processor: bool = False, progress: bool = False
) -> Pilot:
    """Train for some seconds, or until a schedule of PILOT_STEPS ends, with `share="auto"`; keeps nothing.

    So many densification events are passed in a short time, and their number of Gaussians follows that of runs which
    leave nothing out.

    Args:
        config: Settings of training; their length does not matter.
        scene: What is trained.
        seconds: Training time after which the pilot ends.
        by_processor: Count seconds for which this process was running instead of those on the wall.
        progress: Show a progress bar.
    """
    trainer = Trainer(dataclasses.replace(config, max_steps=PILOT_STEPS, schedule_steps=None), scene)
    meter = memory_meter(trainer.backend.device)
    clock = trainer.clock.processor if by_processor else trainer.clock.wall
    samples: list[Sample] = []
    before = 0.0

    def after(iteration: Iteration) -> None:
        nonlocal before
        samples.append(Sample(iteration.step, trainer.num_gaussians, clock.total - before))
        before = clock.total
        trainer.stop_requested = before >= seconds

    first = trainer.num_gaussians
    trainer.on_step = after
    if meter is not None:
        meter.reset()
    with SkipGate(trainer, share="auto") as gate:
        trainer.train(progress=progress)
        shown = gate.report()["gaussians_shown"]
    peak = None if meter is None else meter.peak()
    return Pilot(tuple(samples), first, len(scene.train), shown, trainer.refine_stop_iter, peak)
