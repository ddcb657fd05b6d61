"""Opacities recover from their last reset, positions take no giant steps, and a run without refinement ends well."""

import math
from types import SimpleNamespace

import pytest
import torch

from skipgs_plug import SkipGate
from skipgs_plug.adapters.gsplat_strategy import strategy_events
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.pace.needs import (
    AVERAGING_VISITS,
    LONGEST_POSITIONS,
    LONGEST_STEPS_WITHOUT_REFINEMENT,
    MOST_LAST,
    OPACITY_PATH,
    last_part,
    longest_positions,
    opacity_rate,
)
from skipgs_plug.core.pace.parts import HIGHEST_RECOVERING_RATE, GrowingParts, rate_of_positions
from skipgs_plug.core.pace.phase import Phase, PhasePlan
from skipgs_plug.core.pace.rates import ScaledRates
from skipgs_plug.core.pace.refining import Refining

VIEWS = [f"{i}.png" for i in range(4)]
RATE = 0.1
STRATEGY = SimpleNamespace(refine_start_iter=2, refine_stop_iter=20, refine_every=5, reset_every=8)


@pytest.fixture
def rates():
    scaled = ScaledRates()
    yield scaled
    scaled.remove()


def moved(name, factor, rates, rate=RATE, growing=None, shown=5):
    """Return how far a parameter moves at a gradient of 1, in units of its rate. A view shows `shown` of 5 rows."""
    value = torch.nn.Parameter(torch.zeros(5, 1 if name == "opacity" else 3))
    optimizer = torch.optim.SGD([{"params": [value], "name": name}], lr=rate)
    value.grad = torch.ones_like(value)
    value.grad[shown:] = 0
    rates.scale(factor, growing)
    optimizer.step()
    return -value.detach()[0, 0].item() / rate


@pytest.mark.parametrize(("least", "taken"), [(0.0, 0.025), (0.01, 0.025), (0.05, 0.05), (9.0, 0.1)])
def test_opacities_take_the_rate_that_they_need_in_refinement(least, taken, rates):
    rates.opacity_rate = least
    assert taken <= HIGHEST_RECOVERING_RATE
    assert moved("opacity", 5.0, rates, rate=0.025) == pytest.approx(taken / 0.025)
    assert moved("opacity", 0.5, rates, rate=0.025) == pytest.approx(0.5 * taken / 0.025)
    assert moved("opacity", 5.0, rates, rate=0.2) == pytest.approx(1.0)  # never lower than the trainer's own


def test_a_rate_of_positions_that_falls_too_slowly_is_bounded(rates):
    assert moved("xyz", 10.0, rates) == pytest.approx(20.0)
    rates.positions_rate = 3.0 * RATE
    assert moved("xyz", 10.0, rates) == pytest.approx(3.0)
    # A trainer that has lowered the rate to a tenth gets the steps that it would get without the bound.
    assert moved("xyz", 10.0, rates, rate=RATE / 10) == pytest.approx(20.0)
    assert moved("xyz", 1.0, rates) == pytest.approx(2.0)


def test_the_bound_holds_for_each_step_while_the_trainer_lowers_its_rate(rates):
    value = torch.nn.Parameter(torch.zeros(5, 3))
    optimizer = torch.optim.SGD([{"params": [value], "name": "xyz"}], lr=RATE)
    rates.positions_rate = 3.0 * RATE
    for own in (RATE, RATE / 2, RATE / 10):
        optimizer.param_groups[0]["lr"] = own
        value.data.zero_()
        value.grad = torch.ones_like(value)
        rates.scale(10.0)
        optimizer.step()
        assert -value[0, 0].item() == pytest.approx(min(3.0 * RATE, 20.0 * own))
        assert optimizer.param_groups[0]["lr"] == own


def test_with_more_visits_of_each_view_positions_take_longer_steps():
    assert longest_positions(None) == longest_positions(3.0) == longest_positions(AVERAGING_VISITS) == LONGEST_POSITIONS
    assert longest_positions(4 * AVERAGING_VISITS) == 4 * LONGEST_POSITIONS


@pytest.mark.parametrize("first", [RATE, 0.0])
def test_visits_in_refinement_set_the_bound(first, rates):
    refining = Refining(SkipConfig(share=0.3), rates)
    plan = PhasePlan(range(100, 400), {}, set(), 399, Phase(), VIEWS, len(VIEWS), None, False, positions_rate=first)
    refining.begin(plan)
    refining.runs(100)
    assert rates.positions_rate == (longest_positions(0.3 * 300 / len(VIEWS)) * RATE if first else math.inf)


def test_the_first_rate_of_positions_is_that_of_the_named_group():
    model = torch.nn.Linear(2, 3)
    adam = torch.optim.Adam([{"params": [model.weight], "name": "xyz", "lr": 0.2}], lr=0.1)
    other = torch.optim.Adam([{"params": [model.bias], "name": "opacity", "lr": 0.5}], lr=0.1)
    assert rate_of_positions([other, adam]) == 0.2 and rate_of_positions([other]) == 0.0


def test_the_end_of_a_run_without_refinement():
    assert last_part(7000, None) == last_part(7000, 300) == 700
    assert last_part(7000, 1000) == last_part(7000, 4000) == MOST_LAST == 1000
    assert last_part(30_000, 3000) == 3000
    assert opacity_rate(2000) == OPACITY_PATH / 2000 == 0.05


def test_resets_of_a_strategy_are_known():
    resets = strategy_events(STRATEGY).reset_numbers
    assert list(resets(range(20))) == [8, 16] and list(resets(range(100))) == [8, 16]


class Loop:
    """A loop that densifies every 20 iterations to its end, and resets opacities every 150."""

    LAST = 2000

    def __init__(self):
        self.means = torch.nn.Parameter(torch.rand(6, 3))
        self.opacities = torch.nn.Parameter(torch.rand(6, 1))
        self.bands = torch.nn.Parameter(torch.rand(6, 15, 3))
        values = {"xyz": self.means, "opacity": self.opacities, "f_rest": self.bands}
        self.optimizer = torch.optim.SGD([{"params": [value], "name": name} for name, value in values.items()], lr=1.0)
        self.steps = {}

    def train(self, gate, resets=None, events=range(20, LAST, 20)):
        for step in gate.iterations(range(self.LAST), views=VIEWS, events=events, resets=resets):
            before = self.now
            loss = self.means.sum() - self.opacities.sum() + self.bands.sum()  # opacities rise
            if gate.backward(loss, view=VIEWS[step % 4], step=step):
                self.optimizer.step()
                self.optimizer.zero_grad(set_to_none=True)
            self.steps[step] = tuple(a - b for a, b in zip(before, self.now, strict=True))
        return self

    @property
    def now(self):
        return tuple(value.detach().flatten()[0].item() for value in (self.means, self.opacities, self.bands))


@pytest.mark.parametrize(("compensate", "bands"), [(None, 8.0), (False, 1.0)])
def test_all_iterations_at_the_end_run_and_only_higher_bands_take_longer_steps(compensate, bands):
    with SkipGate(start_iter=5 * Loop.LAST, share="auto", compensate=compensate) as gate:
        loop = Loop().train(gate)
    last = range(Loop.LAST - last_part(Loop.LAST, None), Loop.LAST)
    assert set(last) <= loop.steps.keys()
    assert all(loop.steps[step] == pytest.approx((1.0, -1.0, bands), rel=1e-4) for step in last)
    assert gate.report()["growing"]["iterations_run"] == len(loop.steps)


def test_a_given_share_and_a_run_with_refinement_have_no_such_end():
    for settings in ({"share": 0.25, "start_iter": 5 * Loop.LAST}, {"share": "auto", "start_iter": 200}):
        with SkipGate(**settings) as gate:
            loop = Loop().train(gate)
        last = range(Loop.LAST - last_part(Loop.LAST, None), Loop.LAST)
        assert not set(last) <= loop.steps.keys()
        assert math.isfinite(loop.steps[max(loop.steps)][0])


RESETS = range(150, Loop.LAST - 50, 150)  # the last one in iteration 1,800


def test_steps_are_longer_if_no_refinement_follows_and_opacities_keep_a_rate_that_is_high_already():
    with SkipGate(start_iter=5 * Loop.LAST, share="auto") as gate:
        loop = Loop().train(gate, RESETS)
    growing = gate.report()["growing"]
    assert growing["rate_factor"] == LONGEST_STEPS_WITHOUT_REFINEMENT
    assert growing["opacity_rate_factor"] > 1.0
    earlier = [steps for number, steps in loop.steps.items() if 200 < number < RESETS[-1]]
    assert all(steps == pytest.approx((8.0, -1.0, 16.0), rel=1e-4) for steps in earlier)


@pytest.mark.parametrize(("resets", "whole"), [(RESETS, True), ([], False)])
def test_all_iterations_after_the_last_reset_run_if_densification_ends_late(resets, whole):
    start = Loop.LAST - 100
    with SkipGate(start_iter=start, share="auto") as gate:
        loop = Loop().train(gate, resets)
    last = range(RESETS[-1], start)
    assert (set(last) <= loop.steps.keys()) == whole
    if whole:
        assert all(loop.steps[step] == pytest.approx((1.0, -1.0, 8.0), rel=1e-4) for step in last)


def test_a_run_that_goes_on_long_after_its_last_event_and_reset_is_refined_in_that_time():
    events, resets = range(20, 1000, 20), range(150, 1000, 150)
    with SkipGate(start_iter=Loop.LAST - 50, share="auto") as gate:  # it prunes in iteration 1,950, such as GaussianSpa
        loop = Loop()
        loop.train(gate, resets, events)
    assert gate.report()["growing"]["rate_factor"] < LONGEST_STEPS_WITHOUT_REFINEMENT
    assert not set(range(Loop.LAST - 200, Loop.LAST - 50)) <= loop.steps.keys()


def test_longer_steps_of_opacities_have_a_highest_rate():
    parts = GrowingParts(3.0, 1.0, highest_opacity_rate=0.05)
    assert parts.of_opacities(0.01) == 3.0 and parts.of_opacities(0.025) == 2.0 and parts.of_opacities(0.1) == 1.0
    assert parts.of_opacities(0.0) == 3.0  # a rate that a scheduler has yet to raise
