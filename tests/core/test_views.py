"""View keys."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.views import require_unique, view_key


@pytest.mark.parametrize(
    ("view", "key"),
    [
        ("images/a.png", "images/a.png"),
        (Path("images") / "a.png", "images/a.png"),
        (7, "7"),
        (np.int64(7), "7"),
        (torch.tensor(7), "7"),
        (torch.tensor([7]), "7"),
        (np.array([7]), "7"),
        (("a", 1), "a/1"),
    ],
)
def test_one_view_has_one_text(view, key: str) -> None:
    assert view_key(view) == key


@pytest.mark.parametrize("view", [torch.tensor([1, 2]), torch.tensor(0.5), object(), None, 1.5, ()])
def test_what_may_change_between_runs_is_refused(view) -> None:
    with pytest.raises(SkipGSError, match="view key"):
        view_key(view)


def test_shared_names_are_found() -> None:
    assert require_unique(iter(["a", "b"])) == ["a", "b"]
    assert require_unique([]) == []
    with pytest.raises(SkipGSError, match="'a' names 2"):
        require_unique(["a", "b", "a"])
