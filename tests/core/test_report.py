"""skipgs.json."""

from __future__ import annotations

import json
import math

import pytest
import torch

from skipgs_plug import SkipGate
from skipgs_plug.core.report import write_report

KEYS = {
    "schema_version",
    "settings",
    "released",
    "iterations",
    "gated_iterations",
    "backwards_run",
    "backwards_skipped",
    "min_bwd_ratio_effective",
    "paused",
    "non_finite",
    "reasons",
    "events",
    "t_total",
    "t_post",
    "t_total_processor",
    "t_post_processor",
    "refine_share",
    "gaussians_shown",
    "iterations_run",
    "iterations_skipped",
    "ran_for",
    "always_run",
    "early_stopping",
    "growing",
    "views",
}


def small_run() -> SkipGate:
    gate = SkipGate(start_iter=5, warmup=2, pause_iters=3)
    for step in range(20):
        gate.backward(torch.tensor(1.0 / (step + 1), requires_grad=True), view=step % 2, step=step)
        if step == 10:
            gate.notify_event("prune")
    return gate


def test_content_adds_up(tmp_path) -> None:
    gate = small_run()
    path = tmp_path / "run" / "skipgs.json"
    write_report(gate, path)
    report = json.loads(path.read_text())
    assert set(report) == KEYS
    assert report == gate.report()
    assert report["schema_version"] == 1
    assert 0 <= report["t_post_processor"] <= report["t_total_processor"]
    assert report["iterations"] == 20
    assert report["gated_iterations"] == 15 == report["backwards_run"] + report["backwards_skipped"]
    assert report["paused"] == 3
    assert sum(report["reasons"].values()) == 15
    assert report["settings"]["warmup"] == 2
    assert [row["view"] for row in report["views"]] == ["0", "1"]
    assert sum(row["visits"] for row in report["views"]) == 15
    assert list(path.parent.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch) -> None:
    gate = small_run()
    path = tmp_path / "skipgs.json"
    path.write_text("old")
    monkeypatch.setattr(gate, "report", lambda: {"broken": object()})
    with pytest.raises(TypeError):
        write_report(gate, path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_non_finite_losses_become_null(tmp_path) -> None:
    gate = SkipGate(start_iter=0)
    with pytest.warns(RuntimeWarning):
        gate.backward(torch.tensor(1.0, requires_grad=True) * math.nan, view="a", step=0)
    write_report(gate, tmp_path / "skipgs.json")
    assert json.loads((tmp_path / "skipgs.json").read_text())["views"][0]["last_loss"] is None


def test_a_gate_that_is_off_says_so() -> None:
    gate = SkipGate(enabled=False)
    gate.backward(torch.tensor(1.0, requires_grad=True), view="a", step=0)
    assert gate.summary() == "SkipGS: off, 1 backwards seen."


def test_a_run_that_ends_before_refinement_says_so() -> None:
    gate = SkipGate(start_iter=1000, refine_share=0.4)
    assert gate.summary() == "SkipGS: no iteration of refinement, which begins at iteration 1,000."


def test_a_run_that_was_ended_early_did_not_run_more_than_its_share() -> None:
    gate = SkipGate(start_iter=10, refine_share=0.4)
    for step in gate.iterations(range(100)):
        gate.backward(torch.ones((), requires_grad=True) * 2.0, view=step % 4, step=step)
        if step == 30:
            break
    assert gate.summary().startswith("SkipGS: 21 of 21 iterations run") and "more than" not in gate.summary()
