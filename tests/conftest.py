"""Fixtures for all tests."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from skipgs_plug.core import caution
from skipgs_plug.fallback_raster.runtime import guard

# A shell starts jobs in the background with SIGINT ignored, and the commands that tests interrupt inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def no_warning_of_the_gate_is_missed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Fail a test in which the gate prints an unexpected warning. It prints since warnings are errors in the tests."""
    printed: list[str] = []
    monkeypatch.setattr(caution, "say", printed.append)
    yield
    assert not printed, f"The gate warned, and the test does not expect it: {printed}"


@pytest.fixture
def kernels_checked() -> Iterator[None]:
    """Let every kernel call compare sizes of tensors with declarations, and run torch on one thread.

    SKIPGS_PLUG_GUARD=1 adds guard zones. On a busy machine, several threads are ten times slower for the small
    operations of the reference.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with guard.at_least(guard.SIZES):
        yield
    torch.set_num_threads(threads)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all-lookalikes", action="store_true", help="tests/device: all look-alikes instead of five")


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of reference data and real scenes, which is not part of the repository.

    It lies beside the repository, or where SKIPGS_SHARED says. Tests that need it are skipped without it,
    except in CI, where its absence is a failure.
    """
    folder = Path(os.environ.get("SKIPGS_SHARED") or Path(__file__).parents[2] / "shared")
    if not folder.is_dir():
        message = f"reference data not found at {folder}; set SKIPGS_SHARED"
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    return folder
