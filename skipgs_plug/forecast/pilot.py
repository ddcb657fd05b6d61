"""Run the first iterations of a short schedule and measure them, as the basis of a forecast."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass

from torch import Tensor

from skipgs_plug import SkipGate
from skipgs_plug.bench.memory import memory_meter
from skipgs_plug.core.half_size import in_unit_range, kept_at_half_size, some_of
from skipgs_plug.trainer import Scene, TrainConfig, Trainer
from skipgs_plug.trainer.loop import Iteration

GROUP = 20  # iterations whose mean time counts as one measurement: single times vary too much
PILOT_STEPS = 7000  # iterations in the schedule of the pilot, which runs only the first of them


@dataclass(frozen=True)
class Sample:
    """Measurements of one iteration that ran.

    Attributes:
        step: Number of the iteration in the schedule of the pilot.
        gaussians: Number of Gaussians after the iteration.
        seconds: Duration of the iteration in seconds.
    """

    step: int
    gaussians: int
    seconds: float


@dataclass(frozen=True)
class Pilot:
    """Measurements of a pilot run.

    Attributes:
        samples: The iterations that ran, in order.
        first_gaussians: Number of Gaussians before the first iteration.
        views: Number of training views.
        visible: Share of the Gaussians that a view shows; None if too few iterations ran to measure it.
        stop: Iteration of the pilot's schedule at which densification ends.
        half_size: Whether `share="auto"` would grow the scene on photographs of half the size. The pilot does not.
        peak_memory: Peak memory in bytes, of the process on the CPU and of PyTorch on a GPU; None if unknown.
        fading: Whether the points that the scene begins with fade, as random ones do.
    """

    samples: tuple[Sample, ...]
    first_gaussians: int
    views: int
    visible: float | None
    stop: int
    half_size: bool
    peak_memory: int | None
    fading: bool

    @property
    def grew(self) -> bool:
        """Whether growth can be forecast: an event added Gaussians, or densification ended without one that did."""
        numbers = [self.first_gaussians, *(sample.gaussians for sample in self.samples)]
        return self.samples[-1].step >= self.stop or any(b > a for a, b in itertools.pairwise(numbers))


def run_pilot(
    config: TrainConfig, scene: Scene, seconds: float, by_processor: bool = False, progress: bool = False
) -> Pilot:
    """Train for some seconds, or until a schedule of `PILOT_STEPS` ends, and discard the model.

    At least `GROUP` iterations run after the first one, which waits for kernels.

    The pilot leaves out iterations (`share="auto"`), so it reaches many densification events in a short time. The
    number of Gaussians at each event follows that of runs that leave out nothing.

    Args:
        config: Settings of training. `PILOT_STEPS` replaces the length of its schedule.
        scene: The scene to train.
        seconds: Training time in seconds after which the pilot ends.
        by_processor: Whether to count processor seconds of this process instead of wall-clock seconds.
        progress: Whether to show a progress bar.
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
        trainer.stop_requested = before >= seconds and len(samples) > GROUP

    first = trainer.num_gaussians
    trainer.on_step = after
    if meter is not None:
        meter.reset()
    with SkipGate(trainer, share="auto", half_size=False) as gate:
        trainer.train(progress=progress)
        report = gate.report()
    peak = None if meter is None else meter.peak()

    def photographs() -> Iterator[Tensor]:  # one at a time in memory
        return (in_unit_range(scene.train[i].image) for i in some_of(len(scene.train)))

    halves = kept_at_half_size(photographs).enough
    fading = bool(report["growing"] and report["growing"]["fading"])
    visible, views = report["gaussians_shown"], len(scene.train)
    return Pilot(tuple(samples), first, views, visible, trainer.refine_stop_iter, halves, peak, fading)
