"""Perceptual-GS: its loss of sensitivities lowers opacities, so its folder of points tells whether they are random."""

from types import SimpleNamespace

import pytest
from cases import run, script
from lookalikes import perceptual_gs

from skipgs_plug.core.pace import growing
from skipgs_plug.core.pace.fading import Fading


@pytest.mark.parametrize("known, random", [("points", False), ("no points", True), ("nothing", True)])
def test_points_of_photographs_are_not_taken_for_random_ones(known, random, tmp_path, monkeypatch):
    if known == "points":
        (tmp_path / "sparse").mkdir()
    source = {} if known == "nothing" else {"source_path": str(tmp_path)}
    original = perceptual_gs.dataset
    monkeypatch.setattr(perceptual_gs, "dataset", lambda order=0: SimpleNamespace(**vars(original(order)), **source))
    monkeypatch.setattr(growing, "MEASURED", 2)
    monkeypatch.setattr(Fading, "finish", lambda fading: True)  # most opacities fell
    _, gate = run(script("perceptual_gs", perceptual_gs), share="auto")
    report = gate.report()["growing"]
    assert report["random_points"] == report["fading"] == random
