"""Options of the rasterizer's tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from skipgs_plug.fallback_raster.runtime import guard


@pytest.fixture(autouse=True)
def one_torch_thread() -> Iterator[None]:
    """Run torch on one thread: on a busy machine, several are ten times slower for the reference's small operations."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def sizes_checked() -> Iterator[None]:
    """Let every kernel call compare sizes of tensors with declarations. SKIPGS_PLUG_GUARD=1 adds guard zones."""
    with guard.at_least(guard.SIZES):
        yield


def pytest_addoption(parser: pytest.Parser) -> None:
    """Register the long mode: `pytest tests/fallback_raster/test_stress.py --stress-examples 10000`."""
    parser.addoption(
        "--stress-examples", type=int, default=150, help="generated inputs of the rasterizer's stress suite"
    )


@pytest.fixture
def stress_examples(pytestconfig: pytest.Config) -> int:
    """Return the number of inputs of the stress suite. The option is unknown if pytest starts in a parent folder."""
    return pytestconfig.getoption("--stress-examples", default=150)
