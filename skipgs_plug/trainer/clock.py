"""Time of training by phase, and the threads it is measured with."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import torch

PHASES = ("forward", "loss", "backward", "optimizer", "strategy")


class TrainClock:
    """Adds up the seconds of training iterations; whatever runs between iterations is not counted.

    On CUDA every phase border synchronises, so that a phase holds its own kernels.
    """

    def __init__(self, device: torch.device) -> None:
        self._cuda = device.type == "cuda"
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
        return time.perf_counter()


@contextlib.contextmanager
def torch_threads(count: int, device: torch.device) -> Iterator[None]:
    """Let torch use `count` threads inside the block when training on the CPU.

    The workers of torch spin between operations and take the cores from the rasterizer's own pool: on two busy
    cores, iterations of the demo scene took ten times as long with torch's default.
    """
    previous = torch.get_num_threads()
    if device.type == "cpu" and previous != count:
        torch.set_num_threads(count)
        try:
            yield
        finally:
            torch.set_num_threads(previous)
    else:
        yield
