"""View keys."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from skipgs_plug import SkipGate
from skipgs_plug.adapters import TrainerInfo
from skipgs_plug.core import views
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.views import require_unique, view_key


@pytest.mark.parametrize(
    ("view", "key"),
    [
        ("images/a.png", "images/a.png"),
        (Path("images") / "a.png", "images/a.png"),
        (7, "7"),
        (np.int64(7), "7"),
        (np.str_("a.png"), "a.png"),
        (torch.tensor(7), "7"),
        (torch.tensor([7]), "7"),
        (np.array([7]), "7"),
        (("a", 1), "a/1"),
    ],
)
def test_one_view_has_one_text(view, key: str) -> None:
    assert view_key(view) == key and type(view_key(view)) is str


@pytest.mark.parametrize("view", [torch.tensor([1, 2]), torch.tensor(0.5), object(), None, 1.5, ()])
def test_what_may_change_between_runs_is_refused(view) -> None:
    with pytest.raises(SkipGSError, match="view key"):
        view_key(view)


def test_shared_names_are_found() -> None:
    assert require_unique(iter(["a", "b"])) == ["a", "b"]
    assert require_unique([]) == []
    with pytest.raises(SkipGSError, match="'a' names 2"):
        require_unique(["a", "b", "a"])


def test_an_index_on_a_device_is_read_from_the_start_on_alone() -> None:
    there = torch.tensor(7, device="meta")
    with pytest.raises(SkipGSError, match="view key"):
        view_key(there)  # a tensor without a value cannot be read
    gate = SkipGate(start_iter=3, warmup=0)
    for step in range(3):
        assert gate.backward(torch.tensor(1.0, requires_grad=True), view=there, step=step)
    assert gate.released is None and gate.stats()["iterations"] == 3


def train(gate: SkipGate, keys) -> None:
    for step, key in enumerate(keys, start=gate.stats()["iterations"]):
        gate.backward(torch.tensor(1.0, requires_grad=True), view=key, step=step)


def test_keys_that_do_not_recur_are_warned_about_once_and_forgotten(monkeypatch) -> None:
    monkeypatch.setattr(views, "CHECKED_KEYS", 100)
    monkeypatch.setattr(views, "MAX_VIEWS", 150)
    gate = SkipGate(start_iter=0, warmup=0)
    train(gate, range(99))
    with pytest.warns(RuntimeWarning, match="100 different view keys came in 100 gated decisions") as caught:
        train(gate, range(99, 1000))
    assert len(caught) == 1
    state = gate.state_dict()
    assert 75 <= len(state["policy"]["means"]) == len(state["stats"]["views"]) <= 150
    assert gate.stats()["reasons"] == {"new view": 1000}
    train(gate, [999])  # the latest views are kept
    assert gate.skipped


def test_keys_that_recur_or_are_known_are_not_warned_about(monkeypatch) -> None:
    monkeypatch.setattr(views, "CHECKED_KEYS", 100)
    train(SkipGate(start_iter=0), [*range(98), 0, 1, 98, 99, 100])
    known = SkipGate(start_iter=0)
    known._engine.configure(TrainerInfo(0, view_names=[str(i) for i in range(200)]))
    train(known, range(200))
