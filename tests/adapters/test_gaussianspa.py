"""GaussianSpa: the ADMM phase, the prune right before the gate begins, and shifted iteration numbers."""

import pytest
from cases import PAUSE, RULE, SkipAlways, run, script
from lookalikes import gaussianspa, gaussianspa_op

from skipgs_plug import SkipGSError

MODULES = pytest.mark.parametrize("module", [gaussianspa, gaussianspa_op], ids=["imp_score", "op"])


@MODULES
def test_gate_begins_after_the_sparsifying_phase_and_pauses_for_its_prune(module):
    gated, gate = run(script("", module), **RULE)
    assert gated.structure[-1][:2] == (40, "prune")
    assert gate.trace[0].step == 41  # the adapter counts: update_learning_rate got numbers shifted by 10
    assert [row.reason for row in gate.trace[:PAUSE]] == ["pause"] * PAUSE
    assert gate.stats()["events"] == {"prune_points": 1}


@MODULES
def test_started_earlier_iterations_with_an_admm_term_run_and_are_not_recorded(module):
    admm = [25, 30, 35, 40]
    gated, gate = run(script("", module), start_iter=21, policy=SkipAlways(), record_trace=True)
    assert [row.step for row in gate.trace if not row.skip] == admm
    assert {row.reason for row in gate.trace if row.step in admm} == {"forced"}
    assert [step for step in gated.backwards if step > 20] == admm
    _, gate = run(script("", module), start_iter=21, warmup=0, pause_iters=0, record_trace=True)
    for view in {row.view for row in gate.trace if row.step in admm}:
        recorded = [row for row in gate.trace if row.view == view]
        forced = next(row for row in recorded if row.step in admm)
        later = next(row for row in recorded if row.step > forced.step)
        assert later.mean == forced.mean  # neither seeded nor moved by a loss that holds the term


def test_before_densification_ends_it_is_refused():
    with pytest.raises(SkipGSError, match="start_iter=10 is too early: up to iteration 15"):
        run(script("", gaussianspa), start_iter=10)
