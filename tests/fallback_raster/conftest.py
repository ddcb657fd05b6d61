"""Options of the rasterizer's tests."""

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


def pytest_addoption(parser: pytest.Parser) -> None:
    """Register the long mode: `pytest tests/fallback_raster/test_stress.py --stress-examples 10000`."""
    parser.addoption(
        "--stress-examples", type=int, default=150, help="generated inputs of the rasterizer's stress suite"
    )


@pytest.fixture
def stress_examples(pytestconfig: pytest.Config) -> int:
    """How many inputs the stress suite generates. The option is unknown when pytest starts higher up."""
    return pytestconfig.getoption("--stress-examples", default=150)
