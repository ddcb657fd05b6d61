"""The training clock: time by phase, and the part that falls after densification."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

import torch

PHASES = ("forward", "loss", "backward", "optimizer", "strategy")


@dataclass
class Sums:
    """Seconds of training: in all, and after densification."""

    total: float = 0.0
    post: float = 0.0

    def add(self, seconds: float, after_densification: bool) -> None:
        self.total += seconds
        if after_densification:
            self.post += seconds


class TrainClock:
    """Adds up the seconds of training iterations. Work between iterations is not counted.

    A GPU goes on working while the host is ahead. To measure phases, the clock synchronises at every border of a phase,
    so that a phase contains its own kernels. Without phases, nothing synchronises within iterations: `settle` books
    kernels that are still running, before other work uses the device.

    Args:
        device: Device of the trainer.
        by_processor: `t_total`, `t_post` and `phase_seconds` are processor seconds instead of wall time.
        phases: Measure phases. None: on the CPU, where it costs nothing, but not on a GPU, where they stay 0.

    Attributes:
        wall: Seconds of wall time.
        processor: Seconds for which threads of this process were running, summed over threads. Other programs on the
            machine hardly change them. They do not include the work of a GPU. NaN after a checkpoint without them.
        phase_seconds: Seconds by phase.
    """

    def __init__(self, device: torch.device, by_processor: bool = False, phases: bool | None = None) -> None:
        self._device = None if device.type == "cpu" else device
        self._phases = self._device is None if phases is None else phases
        self._after_densification = False
        self._under_way = False  # whether kernels of the last iteration may still run
        self._by_processor = by_processor
        self.wall, self.processor = Sums(), Sums()
        self.phase_seconds = dict.fromkeys(PHASES, 0.0)
        self._started = (0.0, 0.0)
        self._last = 0.0  # border of the present phase

    @property
    def t_total(self) -> float:
        """Seconds of training."""
        return self._chosen.total

    @property
    def t_post(self) -> float:
        """Seconds of training after densification."""
        return self._chosen.post

    def start(self) -> None:
        if self._phases:
            self._synchronize()
        self._started = self._now()
        self._last = self._started[self._by_processor]

    def mark(self, phase: str) -> None:
        """Book the time since the previous border to `phase`."""
        if not self._phases:
            return
        self._synchronize()
        # Read only one clock: processor seconds take a system call (0.3 to 7 us).
        now = time.process_time() if self._by_processor else time.perf_counter()
        self.phase_seconds[phase] += now - self._last
        self._last = now

    def stop(self, after_densification: bool) -> None:
        if not self._phases and after_densification != self._after_densification:
            self._synchronize()  # no kernel of densification counts as refinement
        wall, processor = self._now()
        if self._phases:  # the iteration ends with its last phase
            wall, processor = (wall, self._last) if self._by_processor else (self._last, processor)
        self._after_densification = after_densification
        self._under_way = self._device is not None and not self._phases
        self._book((wall, processor))

    def settle(self) -> None:
        """Wait for running kernels and book their time, before an evaluation, a checkpoint or other work follows."""
        if self._under_way:
            self._started = self._now()
            self._synchronize()
            self._book(self._now())
            self._under_way = False

    def _book(self, end: tuple[float, float]) -> None:
        self.wall.add(end[0] - self._started[0], self._after_densification)
        self.processor.add(end[1] - self._started[1], self._after_densification)

    def seconds(self) -> dict[str, float]:
        """Return `t_total` and `t_post` in wall time and, with `_processor` after the name, in processor seconds."""
        return {
            "t_total": self.wall.total,
            "t_post": self.wall.post,
            "t_total_processor": self.processor.total,
            "t_post_processor": self.processor.post,
        }

    def state_dict(self) -> dict[str, float]:
        return {**self.seconds(), **self.phase_seconds}

    @staticmethod
    def can_load(state: Mapping[str, float]) -> bool:
        """Whether this is a state of a clock, possibly of a version without processor seconds."""
        return {"t_total", "t_post", *PHASES} <= state.keys() <= {*TrainClock(torch.device("cpu")).state_dict()}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Continue from `state_dict()`. Processor seconds become NaN if the state is of a version without them."""
        self.wall = Sums(state["t_total"], state["t_post"])
        self.processor = Sums(state.get("t_total_processor", math.nan), state.get("t_post_processor", math.nan))
        self.phase_seconds.update({phase: state[phase] for phase in PHASES})

    @property
    def _chosen(self) -> Sums:
        return self.processor if self._by_processor else self.wall

    def _synchronize(self) -> None:
        if self._device is not None:
            getattr(torch, self._device.type).synchronize()

    @staticmethod
    def _now() -> tuple[float, float]:
        """Return wall time and processor seconds."""
        return time.perf_counter(), time.process_time()
