"""3DGS-MCMC: noise follows the gate, and relocation is never left out."""

import torch
from cases import SkipAlways, run, script
from lookalikes import gsplat_runner, mcmc

from skipgs_plug.adapters.gsplat_strategy import strategy_events
from skipgs_plug.adapters.inria import InriaFamily
from skipgs_plug.adapters.mcmc import MCMC
from skipgs_plug.core import decision

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
