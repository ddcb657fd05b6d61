"""Options of the rasterizer's tests."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Register the long mode: `pytest tests/fallback_raster/test_stress.py --stress-examples 10000`."""
    parser.addoption(
        "--stress-examples", type=int, default=150, help="generated inputs of the rasterizer's stress suite"
    )


@pytest.fixture
def stress_examples(pytestconfig: pytest.Config) -> int:
    """How many inputs the stress suite generates. The option is unknown when pytest starts higher up."""
    return pytestconfig.getoption("--stress-examples", default=150)
