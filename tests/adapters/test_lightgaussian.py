"""LightGaussian's three scripts: where the gate begins, and jittered views."""

from cases import RULE, run, script
from lookalikes import lightgaussian_densify_prune, lightgaussian_distill, lightgaussian_prune_finetune
from lookalikes.splats import NAMES

from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.engine import Engine
from skipgs_plug.core.trainer_info import TrainerInfo


def test_start_is_relative_to_the_first_iteration():
    settings = {"warmup": 0, "pause_iters": 5, "record_trace": True}
    gated, gate = run(script("", lightgaussian_prune_finetune), **settings)
    assert gated.structure == [(31, "prune", 15)] and gate.config.start_iter == 32
    assert [row.reason for row in gate.trace[:6]] == ["pause"] * 5 + [
        "new view"
    ]  # the pause seeds no mean with losses after the prune
    assert run(script("", lightgaussian_distill), **settings)[1].config.start_iter == 31
    assert run(script("", lightgaussian_densify_prune), **settings)[1].config.start_iter == 20


def test_refinement_begins_after_the_last_prune_if_iterations_are_left_out():
    gated, gate = run(script("", lightgaussian_densify_prune), share=0.5)
    assert [step for step, kind, _ in gated.structure if kind == "prune"][-2:] == [30, 45]
    assert gate.config.start_iter == 46
    assert run(script("", lightgaussian_densify_prune), refine_share=0.5)[1].config.start_iter == 46


def test_refinement_waits_for_changes_that_end_after_the_last_prune():
    for start, first in ((20, 46), (50, 50), (None, 46)):
        engine = Engine(SkipConfig(share=0.5))
        engine.configure(TrainerInfo(start, settled_iter=46))
        assert engine.start == first


def test_jittered_views_have_means_of_their_own():
    _, gate = run(script("", lightgaussian_distill), **RULE)
    for row in gate.trace:
        assert row.view.endswith("/jittered") == (row.step % 3 != 0)
    assert {row["view"].removesuffix("/jittered") for row in gate.view_table()} == set(NAMES)
    _, gate = run(script("", lightgaussian_distill, augmented_view=False), **RULE)
    assert {row["view"] for row in gate.view_table()} == set(NAMES)


def test_user_may_start_elsewhere():
    _, gate = run(script("", lightgaussian_prune_finetune), start_iter=50, **RULE)
    assert gate.trace[0].step == 50
