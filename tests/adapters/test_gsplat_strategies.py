"""gsplat's Runner with strategies of others: what they do beyond gsplat's is seen before the run, and none is lost."""

import dataclasses

import pytest
from cases import RULE, SkipAlways
from lookalikes.gsplat_runner import DefaultStrategy, MCMCStrategy, Runner
from lookalikes.splats import log, new_log

from skipgs_plug import AdapterMismatchError, SkipGate, SkipGSError
from skipgs_plug.adapters.loop_bounds import READS_GRADIENT, CallReader


@dataclasses.dataclass
class Trimming(DefaultStrategy):
    """Prunes after densification, in calls that do not end with it."""

    trim_until: int = 40

    def trim(self):
        """Stand for a change of the model."""

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        super().step_post_backward(params, optimizers, state, step, info, packed)
        if step < self.trim_until:
            self.trim()


@dataclasses.dataclass
class Gathering(DefaultStrategy):
    """Gathers gradients for longer than it densifies."""

    gather_until: int = 40

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        super().step_post_backward(params, optimizers, state, step, info, packed)
        if step < self.gather_until:
            state["all"] = state.get("all", 0.0) + info["means2d"].grad.norm()


class PuttingOff(DefaultStrategy):
    """Densifies for longer while there are few Gaussians."""

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        if step == self.refine_stop_iter - 1 and len(params["xyz"]) < 100:
            self.refine_stop_iter += 5
        super().step_post_backward(params, optimizers, state, step, info, packed)


class OfItsOwn:
    """Derives from nothing of gsplat's, with names of its own for its schedule."""

    densify_until, every, absgrad = 20, 5, False

    def step_pre_backward(self, params, optimizers, state, step, info):
        info["means2d"].retain_grad()

    def step_post_backward(self, params, optimizers, state, step, info, lr):
        if step >= self.densify_until:
            return
        state["norms"] = info["means2d"].absgrad if self.absgrad else info["means2d"].grad.norm()


class OfMyOwn(Runner):
    """Overrides the loop, and calls it."""

    def train(self):
        super().train()


class Fading(MCMCStrategy):
    """Does something by number, beside the noise of its parent."""

    def step_post_backward(self, params, optimizers, state, step, info, lr):
        super().step_post_backward(params, optimizers, state, step, info, lr)
        if step % 10 == 0:
            log.structure.append((step, "fade", len(params["xyz"])))


@pytest.mark.parametrize("runner", [Runner, OfMyOwn])
@pytest.mark.parametrize("strategy, said", [(Trimming, r"trim\(\)"), (Gathering, "for the grad of a tensor")])
@pytest.mark.filterwarnings("ignore:The trainer does more than")
def test_the_gate_begins_after_the_last_change_and_the_last_gradient_that_is_read(runner, strategy, said):
    new_log()
    with pytest.warns(RuntimeWarning, match=f"starts at iteration 40 instead of 20: the loop calls {said} until"):
        gate = SkipGate(runner(strategy()), policy=SkipAlways())
    with gate:
        gate.adapter.trainer.train()
    assert log.backwards == list(range(40))


def test_gradients_that_are_read_until_the_end_are_refused():
    with pytest.raises(AdapterMismatchError, match=r"reads gradients \(grad\) until its end"):
        SkipGate(Runner(Gathering(gather_until=60)), share="auto")


def test_an_end_of_densification_that_moves_is_refused():
    with pytest.raises(AdapterMismatchError, match="itself sets densify_until_iter or refine_stop_iter"):
        SkipGate(Runner(PuttingOff()), share="auto")


def test_densification_after_the_end_of_the_run_is_no_reason_to_refuse():
    gate = SkipGate(Runner(DefaultStrategy(refine_stop_iter=15_000)), **{**RULE, "start_iter": None})
    assert gate.config.start_iter == 15_000
    gate.detach()


def test_a_strategy_with_names_of_its_own_is_gated_when_it_reads_no_gradients_any_more():
    new_log()
    runner = Runner(OfItsOwn())
    with SkipGate(runner, policy=SkipAlways()) as gate:
        runner.train()
    assert log.backwards == list(range(20)) and gate.config.start_iter == 20
    with pytest.raises(SkipGSError, match="start_iter=15 is too early"):
        SkipGate(Runner(OfItsOwn()), start_iter=15)


def test_only_the_noise_of_mcmc_is_left_out():
    new_log()
    runner = Runner(Fading())
    with SkipGate(runner, policy=SkipAlways()) as gate:
        runner.train()
    assert [step for step, kind, _ in log.structure if kind == "fade"] == list(range(0, 60, 10))
    assert gate.report()["backwards_skipped"] == 40 and runner.cfg.strategy.noise_lr == 5e5


def test_gradients_that_are_compared_with_none_under_a_name_are_expected_to_be_none():
    def sparse(values):
        for value in values:
            grad = value.grad
            if grad is None:
                continue
            grad.to_sparse()

    def dense(values):
        for value in values:
            grad = value.grad
            grad.to_sparse()

    def both(values):
        sparse(values)
        grad = values[0].grad
        if grad is None:
            dense(values)

    def asserted(values):
        assert values[0].grad is not None

    found = {}
    for function in (sparse, dense, both, asserted):
        reader = CallReader()
        reader.trainer.add(function)
        reader.read(function, {"step"}, {})
        found[function] = READS_GRADIENT in reader.ends
    assert found == {sparse: False, dense: True, both: True, asserted: True}
