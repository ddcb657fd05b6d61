"""FastGS, Improved-GS and Taming: steps on gradients that are accumulated over several iterations."""

import pytest
import torch
from cases import SkipAlways, run, script
from lookalikes import fastgs, improved_gs, taming
from lookalikes.splats import Log, SplatModel, log

from skipgs_plug.adapters import fastgs as adapter
from skipgs_plug.adapters.fastgs import FastGS
from skipgs_plug.adapters.improved_gs import ImprovedGS
from skipgs_plug.core import decision
from skipgs_plug.core.pace import fading, growing
from skipgs_plug.core.pace.rates import path_factor
from skipgs_plug.core.trainer_info import Densification

CASES = {"fastgs": script("fastgs", fastgs), "taming": script("taming", taming, sh_lower=True)}
CASES["improved_gs"] = script("improved_gs", improved_gs)


class SkipWhenDue(SkipAlways):
    """Skips exactly the iterations in which accumulated gradients are to be applied."""

    def decide(self, view, loss, step):
        return decision.AT_OR_BELOW_MEAN if step % 8 == 0 else decision.ABOVE_MEAN


def moved(log: Log, name: str) -> list[int]:
    """Iterations in which a parameter changed and kept its size."""
    index = ["xyz", "f_dc", "f_rest", "opacity", "scaling", "rotation"].index(name)
    steps = sorted(log.values)
    pairs = [(i, log.values[i][index], log.values[i + 1][index]) for i in steps[:-1]]
    return [i for i, a, b in pairs if a.shape == b.shape and not torch.equal(a, b)]


def test_fastgs_applies_the_sum_of_backwards_that_ran():
    gated, gate = run(CASES["fastgs"], policy=SkipWhenDue())
    assert [i for i in range(20, 65) if i not in gated.backwards] == [24, 32, 40, 48, 56, 64]
    # Iteration 32 prunes too. New parameters have no gradient, as in the trainer itself, so its step changes nothing.
    assert [step for step in gated.steps if step > 20] == [24, 40, 48, 56]
    assert moved(gated, "f_rest")[-3:] == [40, 48, 56] and moved(gated, "xyz")[-3:] == [40, 48, 56]
    assert gate.report()["backwards_skipped"] == 6


def test_taming_applies_pending_sh_gradients():
    gated, _ = run(CASES["taming"], policy=SkipWhenDue())
    assert moved(gated, "f_rest") == [8, 16, 24, 32, 40, 48, 56]
    assert not set(moved(gated, "xyz")) & {24, 32, 40, 48, 56}  # the other optimizer has no pending gradient there


def test_prunes_of_fastgs_are_events():
    gated, gate = run(CASES["fastgs"], warmup=0, pause_iters=6, record_trace=True)
    assert [step for step, kind, _ in gated.structure if step > 20] == list(fastgs.PRUNES)
    assert gate.stats()["events"] == {"prune_points": 2}
    assert [row.step for row in gate.trace if row.reason == "pause"] == [*range(33, 39), *range(45, 51)]


def test_growth_without_an_event_that_the_loop_tells_runs_whole(monkeypatch):
    monkeypatch.setattr(FastGS, "densification", Densification(marks=("interval_of_another_name",)))
    with pytest.warns(RuntimeWarning, match="that names interval_of_another_name holds before iteration 20"):
        gated, _ = run(CASES["fastgs"], share=0.5)
    assert gated.backwards[:19] == list(range(1, 20)) and len(gated.backwards) < 64


@pytest.mark.parametrize("settings", [{"share": 0.4}, {"grow_share": 0.4}])
@pytest.mark.parametrize("name", ["improved_gs", "fastgs"])
def test_densification_runs_whole_before_steps_with_accumulated_gradients(monkeypatch, name, settings):
    shorter, _ = run(CASES[name], **settings)
    monkeypatch.setattr(ImprovedGS, "accumulates_from", 20)
    monkeypatch.setattr(adapter, "ACCUMULATES_FROM", 20)
    gated, gate = run(CASES[name], **settings)
    grown, before = ([step for step in one.backwards if step < 20] for one in (gated, shorter))
    assert len(before) < 16
    assert grown == list(range(1, 20)) if "share" in settings else len(grown) < 16  # grow_share is the user's wish
    if "share" in settings:
        assert len([step for step in gated.backwards if step >= 20]) < 45
        assert "18 of 18 iterations run (100.0 %) while the scene grows" in gate.summary()


def factors_of(case, lookalike, monkeypatch, **settings):
    """Run a look-alike; return its log, its gate, and the factor on each rate by iteration and group."""
    factors = {}

    class Adam(torch.optim.Adam):
        def step(self, closure=None):
            for group in self.param_groups:
                factors[log.now, group["name"]] = group["lr"] / SplatModel.rates[group["name"]]
            return super().step(closure)

    monkeypatch.setattr(lookalike.GaussianModel, "adam", Adam)
    monkeypatch.setattr(lookalike.GaussianModel, "update_learning_rate", lambda self, iteration: None)
    gated, gate = run(case, **settings)
    return gated, gate, factors


@pytest.mark.parametrize("compensate", [None, False])
def test_steps_with_fewer_gradients_are_longer_and_shrink(monkeypatch, compensate):
    monkeypatch.setattr(ImprovedGS, "accumulates_from", 20)
    settings = {"refine_share": 0.25, "compensate": compensate}
    gated, gate, factors = factors_of(CASES["improved_gs"], improved_gs, monkeypatch, **settings)
    # All steps of the own run but the last one happen: in every 4th iteration, then in every 8th.
    assert sorted({step for step in gated.steps if step > 20}) == [24, 28, 32, 36, 40, 48, 56]
    for step in (24, 40, 48, 56):
        shrunk = 2.0 / 0.25**0.5 * (1.0 - (step - 20) / 45)  # refinement has 45 iterations
        assert factors[step, "rotation"] == pytest.approx(1.0 if compensate is False else shrunk)
        assert factors[step, "opacity"] == pytest.approx(1.0 if compensate is False else min(shrunk, 1.0))
    assert factors[19, "rotation"] == 1.0
    assert gate.report()["gaussians_shown"] is None  # a gradient is gathered from several views


def test_refinement_of_fastgs_steps_as_densification_does(monkeypatch):
    monkeypatch.setattr(adapter, "ACCUMULATES_FROM", 20)
    monkeypatch.setattr(adapter, "BOTH_STEP", fastgs.STEP_EVERY)
    gated, gate, factors = factors_of(CASES["fastgs"], fastgs, monkeypatch, refine_share=0.25)
    ran = [step for step in gated.backwards if 20 < step < 64 and step not in fastgs.PRUNES]
    assert set(ran) == {step for step in gated.steps if 20 < step < 64} and 8 < len(ran) < 16
    assert any(step % fastgs.STEP_EVERY for step in ran)  # the script alone would not step there
    assert gate.report()["gaussians_shown"] > 0.5  # it is measured, since each gradient is of one view
    for step in ran:
        assert factors[step, "rotation"] > path_factor(0.25, (step - 20) / 45)  # if a third is shown
    step = [step for step in gated.backwards if step > 20][fastgs.STEP_EVERY - 1]
    assert [one for one in ran if (one, "f_rest") in factors] == [step]
    assert factors[step, "f_rest"] == pytest.approx(4.0 * factors[step, "rotation"])


def test_fastgs_accumulates_if_steps_stay_as_they_are(monkeypatch):
    monkeypatch.setattr(adapter, "ACCUMULATES_FROM", 20)
    monkeypatch.setattr(adapter, "interval", lambda iteration: 8)
    gated, _ = run(CASES["fastgs"], refine_share=0.25, compensate=False)
    # Iteration 32 prunes. Its new parameters have no gradient.
    assert [step for step in gated.steps if step > 20] == [24, 40, 48, 56]


def test_opacities_of_fastgs_keep_their_beta2_while_the_scene_grows(monkeypatch):
    betas = {}

    class Adam(torch.optim.Adam):
        def step(self, closure=None):
            for group in self.param_groups:
                betas.setdefault((group["name"], log.now < 20), set()).add(group["betas"][1])
            return super().step(closure)

    monkeypatch.setattr(fastgs.GaussianModel, "adam", Adam)
    monkeypatch.setattr(growing, "MEASURED", 2)
    monkeypatch.setattr(fading, "MOST", 1.0)  # two steps do not tell whether points fade
    run(CASES["fastgs"], share=0.5)
    assert betas["opacity", True] == {0.999} and betas["opacity", False] == {0.98}
    assert 0.98 in betas["xyz", True]
