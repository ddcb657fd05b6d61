"""Checks and options of the rasterizer's tests."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def all_kernels_checked(kernels_checked: None) -> None:
    """Check the kernel calls of every test in this folder."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Register the long mode: `pytest tests/fallback_raster/test_stress.py --stress-examples 10000`."""
    parser.addoption(
        "--stress-examples", type=int, default=150, help="generated inputs of the rasterizer's stress suite"
    )


@pytest.fixture
def stress_examples(pytestconfig: pytest.Config) -> int:
    """Return the number of inputs of the stress suite. The option is unknown if pytest starts in a parent folder."""
    return pytestconfig.getoption("--stress-examples", default=150)
