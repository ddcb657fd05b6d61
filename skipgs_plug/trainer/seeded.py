"""Random numbers from the global generator that depend on a seed alone."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch

DRAWING = threading.Lock()  # held while a trainer draws random numbers: gsplat uses one generator for all threads


@contextmanager
def seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Seed the global generators, which gsplat uses, and restore their state at the end of the block.

    Args:
        seed: The seed.
        device: Device that the block draws on, besides the CPU. Without it PyTorch would initialise every GPU.
    """
    devices = [] if device.type == "cpu" else [device]
    with DRAWING, torch.random.fork_rng(devices=devices):
        torch.manual_seed(seed)
        yield
