"""3DGS-MCMC: noise follows the gate, and relocation is never left out."""

from types import SimpleNamespace

import pytest
import torch
from cases import SkipAlways, gsplat, run, script
from lookalikes import gsplat_runner, mcmc
from lookalikes.splats import log

from skipgs_plug.adapters.gsplat_strategy import strategy_events
from skipgs_plug.adapters.inria import InriaFamily
from skipgs_plug.adapters.loop_code import asks_for_random_points
from skipgs_plug.adapters.mcmc import MCMC
from skipgs_plug.core import decision
from skipgs_plug.core.pace import growing, growing_steps, needs

CASE = script("mcmc", mcmc)


class SkipOdd(SkipAlways):
    def decide(self, view, loss, step):
        return decision.AT_OR_BELOW_MEAN if step % 2 else decision.ABOVE_MEAN


def test_noise_moves_positions_in_exactly_the_iterations_with_a_backward():
    gated, _ = run(CASE, policy=SkipOdd())
    positions = {step: values[0] for step, values in gated.values.items()}
    moved = [step for step in range(20, 60) if not torch.equal(positions[step], positions[step + 1])]
    assert moved == list(range(20, 60, 2))


def test_gate_started_early_runs_the_iterations_that_relocate():
    plain, _ = run(CASE)
    gated, gate = run(CASE, policy=SkipAlways(), start_iter=8, record_trace=True)
    relocations = [step for step, kind, _ in plain.structure if kind == "relocate"]
    assert relocations == [5, 10, 15] and [s for s, *_ in gated.structure] == relocations
    assert gated.backwards == [*range(1, 8), 10, 15]
    assert [row.step for row in gate.trace if row.reason == "forced"] == [10, 15]


def test_longer_steps_are_tolerated_where_opacities_are_never_reset():
    assert not MCMC.densification.resets and InriaFamily.densification.resets
    assert not strategy_events(gsplat_runner.MCMCStrategy()).resets
    assert strategy_events(gsplat_runner.DefaultStrategy()).resets


def test_the_options_of_the_loop_tell_of_random_points_and_not_their_defaults():
    random, sfm, other = SimpleNamespace(init_type="random"), SimpleNamespace(init_type="sfm"), SimpleNamespace()
    assert asks_for_random_points({"dataset": random, "opt": other}) is True
    assert asks_for_random_points({"args": random}) is True
    assert asks_for_random_points({"lp": random, "dataset": sfm, "args": random}) is False
    assert asks_for_random_points({"lp": random, "dataset": other}) is None


@pytest.mark.parametrize("init_type", ["sfm", "random"])
@pytest.mark.parametrize("name", ["script", "gsplat"])
def test_random_points_need_more_iterations(name, init_type, monkeypatch):
    """A regulariser lets all opacities fall, so that only the trainer's option tells of random points."""
    for name_of_need in ("LEAST_GROWING_STEPS", "LEAST_GROWING_STEPS_LONGER", "STEPS_PER_EVENT", "GROWING_VISITS"):
        monkeypatch.setattr(needs, name_of_need, 1)
    monkeypatch.setattr(needs, "GROWING_SIGHTS_IF_MOVED", 16)
    monkeypatch.setattr(growing, "MEASURED", 2)
    runner, strategy = gsplat_runner.Runner, gsplat_runner.MCMCStrategy
    cases = {
        "script": script("mcmc", mcmc, init_type=init_type),
        "gsplat": gsplat("mcmc", runner, strategy, init_type=init_type),
    }
    _, gate = run(cases[name], share="auto")
    report, is_random = gate.report()["growing"], init_type == "random"
    assert report["random_points"] == is_random and not report["fading"]
    assert (report["share"] > 0.7) == is_random
    assert ("random points" in gate.summary()) == is_random


@pytest.mark.parametrize("init_type", ["sfm", "random"])
def test_the_beta2_stays_where_views_show_few_of_the_random_points(init_type, monkeypatch):
    betas = {}

    class Adam(torch.optim.Adam):
        def step(self, closure=None):
            for group in self.param_groups:
                betas.setdefault(log.now < 20, set()).add(group["betas"][1])
            return super().step(closure)

    monkeypatch.setattr(torch.optim, "Adam", Adam)
    monkeypatch.setattr(growing, "MEASURED", 2)
    monkeypatch.setattr(growing_steps, "SELDOM_SHOWN", 1.1)
    run(gsplat("mcmc", gsplat_runner.Runner, gsplat_runner.MCMCStrategy, init_type=init_type), share=0.3)
    assert (betas[True] == {0.999}) == (init_type == "random")
    assert 0.98 in betas[False]  # refinement is as ever
