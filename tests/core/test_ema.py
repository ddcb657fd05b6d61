"""Running means per view."""

from __future__ import annotations

import pytest

from skipgs_plug.core.ema import ViewMeans


def test_seeds_then_decays() -> None:
    means = ViewMeans(0.9)
    assert means.update("a", 1.0) is None
    assert means.update("a", 2.0) == 1.0
    assert means.get("a") == pytest.approx(1.1)
    assert means.get("b") is None
    assert len(means) == 1


def test_a_restored_view_gets_its_own_key_back() -> None:
    means = ViewMeans(0.9)
    means.load_state_dict({"(1, 'a')": 1.0, "2": 3.0})
    assert means.get((1, "a")) == 1.0
    assert means.update((1, "a"), 1.0) == 1.0
    assert means.update(2, 3.0) == 3.0
    assert set(means.values) == {(1, "a"), 2}
