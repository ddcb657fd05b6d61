"""Speedy-Splat's own backwards, in skipped iterations too."""

from cases import SkipAlways, run, script
from lookalikes import speedy_splat

CASE = script("speedy_splat", speedy_splat)


def test_prunes_in_skipped_iterations_run_their_backwards():
    gated, gate = run(CASE, policy=SkipAlways())
    prunes = [step for step, kind, _ in gated.structure if kind == "prune" and step not in (5, 15)]
    assert prunes == [10, 10, 20, 30, 40, 50, 60]  # iteration 10 prunes twice: in densification, then by scores
    prunes.remove(10)
    assert gated.other_backwards == len(prunes) * 5
    assert not {30, 40, 50, 60} & set(gated.backwards)
    assert gate.stats()["events"] == {"prune_points": 5}  # the prune of densification is no event
    assert gate.report()["iterations"] == 60  # backward passes for scores do not count as training


def test_gate_begins_after_the_prune_that_ends_densification():
    _, gate = run(CASE, warmup=0, pause_iters=4, record_trace=True)
    assert [(row.step, row.reason) for row in gate.trace[:5]] == [
        *((step, "pause") for step in range(21, 25)),
        (25, "new view"),
    ]
