"""The garbage collector while a program starts."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

from skipgs_plug.garbage import keep_everything, uncollected


@pytest.fixture(autouse=True)
def unfrozen() -> Iterator[None]:
    gc.unfreeze()
    yield
    gc.unfreeze()


def test_the_collector_is_off_inside_the_block_and_on_again_after_it() -> None:
    with uncollected():
        assert not gc.isenabled()
    assert gc.isenabled() and not gc.get_freeze_count()
    gc.disable()
    with uncollected():
        pass
    assert not gc.isenabled()
    gc.enable()


def test_a_program_that_keeps_everything_scans_nothing_of_the_block_afterwards() -> None:
    keep_everything()
    before = gc.get_freeze_count()
    with uncollected():
        made = [[] for _ in range(5000)]
    assert gc.get_freeze_count() >= before + len(made) and gc.get_count()[0] < 700
