"""The training clock: time by phase, and the part that falls after densification."""

from __future__ import annotations

import time

import torch

PHASES = ("forward", "loss", "backward", "optimizer", "strategy")


class TrainClock:
    """Adds up the seconds of training iterations; whatever runs between iterations is not counted.

    On CUDA every phase border synchronises, so that a phase holds its own kernels.

    Args:
        processor: count the seconds for which the threads of this process are running, all together, instead of those
            of a clock on the wall; without CUDA. Other programs on the machine hardly change them.
    """

    def __init__(self, device: torch.device, processor: bool = False) -> None:
        self._cuda = device.type == "cuda"
        self._read = time.process_time if processor else time.perf_counter
        self.phase_seconds = dict.fromkeys(PHASES, 0.0)
        self.t_total = 0.0
        self.t_post = 0.0
        self._started = self._last = 0.0

    def start(self) -> None:
        self._started = self._last = self._now()

    def mark(self, phase: str) -> None:
        """Book the time since the previous border to `phase`."""
        now = self._now()
        self.phase_seconds[phase] += now - self._last
        self._last = now

    def stop(self, after_densification: bool) -> None:
        elapsed = self._last - self._started
        self.t_total += elapsed
        if after_densification:
            self.t_post += elapsed

    def state_dict(self) -> dict[str, float]:
        return {"t_total": self.t_total, "t_post": self.t_post, **self.phase_seconds}

    def load_state_dict(self, state: dict[str, float]) -> None:
        self.t_total, self.t_post = state["t_total"], state["t_post"]
        self.phase_seconds.update({phase: state[phase] for phase in PHASES})

    def _now(self) -> float:
        if self._cuda:
            torch.cuda.synchronize()
        return self._read()
