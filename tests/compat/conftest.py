"""Tests of the stand-ins check sizes at each kernel call, and run torch on one thread."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from skipgs_plug.fallback_raster.runtime import guard


@pytest.fixture(autouse=True)
def one_torch_thread() -> Iterator[None]:
    """The reference is thousands of small operations, which are ten times slower on a busy machine's threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def sizes_checked() -> Iterator[None]:
    """Every kernel call compares the sizes of its tensors with what it declares; SKIPGS_PLUG_GUARD=1 does more."""
    with guard.at_least(guard.SIZES):
        yield
