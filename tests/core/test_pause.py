"""Pauses after structural changes."""

from __future__ import annotations

from skipgs_plug.core.pause import Pause


def test_lasts_an_epoch_or_500_iterations() -> None:
    pause = Pause()
    assert pause.extend(10, n_views=20) == 500
    assert pause.until == 511
    assert Pause().extend(10, n_views=2000) == 2000


def test_overlapping_changes_extend_once() -> None:
    pause = Pause(10)
    assert pause.extend(0, 1) == 10
    assert pause.extend(0, 1) == 0
    assert pause.extend(4, 1) == 4
    assert pause.until == 15
    assert pause.changes == 2


def test_can_be_switched_off() -> None:
    pause = Pause(0)
    assert pause.extend(7, 100) == 0
    assert pause.changes == 0
