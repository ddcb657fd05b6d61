"""Kernel calls in tests of the stand-ins are checked."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def all_kernels_checked(kernels_checked: None) -> None:
    """Check the kernel calls of every test in this folder."""
