"""Longer steps do not make a Gaussian larger than the scene."""

import math

import pytest
import torch

from skipgs_plug.core.pace.parts import GrowingParts
from skipgs_plug.core.pace.size_bound import SPREAD, SizeBound

TIMES = 6.0  # scales take twice the common factor of 3
RATE = 0.1
BOUND = math.log(2.0 * SPREAD)  # in the model below


def positions():
    """Five positions in a row. Their median distance from their median is 2."""
    return torch.tensor([-50.0, -2.0, 0.0, 1.0, 2.0])[:, None] * torch.tensor([1.0, 0.0, 0.0])


def model(sizes, scales="scaling"):
    """Optimizer of positions and scales of Gaussians of these sizes, a row each, with a rate of 0.1."""
    groups = {"xyz": positions(), scales: torch.tensor(sizes).log()}
    params = [{"params": [torch.nn.Parameter(value)], "name": name} for name, value in groups.items()]
    return torch.optim.SGD(params, lr=RATE), params[1]["params"][0]


def step(optimizer, scales, direction):
    """Take a step in which all sizes grow (1) or shrink (-1), and return how far they went in units of the rate."""
    for group in optimizer.param_groups:
        group["params"][0].grad = torch.zeros_like(group["params"][0])
    scales.grad = torch.full_like(scales, -direction)
    before = scales.detach().clone()
    optimizer.step()
    return ((scales.detach() - before) / (RATE * direction)).round(decimals=3)


@pytest.mark.parametrize("growing", [None, GrowingParts(1.0, 2.0, 2.0)])
def test_sizes_beyond_the_scene_grow_as_in_the_trainers_own_steps(rates, growing):
    bound = math.exp(BOUND)
    optimizer, scales = model(
        [[0.1, 0.5, 1.0], [1.0, 2 * bound, bound], [0.1, 0.999 * bound, 1.0], [1.0] * 3, [1.0] * 3]
    )
    rates.scale(3.0, growing)
    moved = step(optimizer, scales, 1.0)
    assert moved[[0, 3, 4]].eq(TIMES).all()
    assert moved[1].tolist() == [TIMES, 1.0, 1.0]  # each axis for itself
    assert moved[2].tolist() == [TIMES, pytest.approx(1.0, abs=0.02), TIMES]  # no longer step goes beyond the bound
    rates.scale(3.0, growing)
    assert step(optimizer, scales, -1.0).eq(TIMES).all()  # sizes shrink as all parameters move


def test_growing_phases_without_a_bound_make_all_sizes_larger(rates):
    optimizer, scales = model([[100.0]] * 5)
    rates.scale(3.0, GrowingParts(1.0, 2.0, 2.0, bounded=False))
    assert step(optimizer, scales, 1.0).eq(TIMES).all()


def test_steps_that_are_not_longer_are_the_trainers_own(rates):
    optimizer, scales = model([[100.0]] * 5)
    rates.scale(0.25)
    assert step(optimizer, scales, 1.0).eq(0.5).all()


def test_the_bound_is_that_of_the_first_step(rates):
    optimizer, scales = model([[1.0]] * 5)
    rates.scale(3.0)
    step(optimizer, scales, 1.0)
    assert rates.sizes.state_dict() == pytest.approx(BOUND)
    with torch.no_grad():
        optimizer.param_groups[0]["params"][0] *= 1000.0
        scales.fill_(BOUND + 1.0)
    rates.scale(3.0)
    assert step(optimizer, scales, 1.0).eq(1.0).all()
    assert rates.sizes.state_dict() == pytest.approx(BOUND)


def test_rates_are_the_trainers_after_a_step_that_cannot_be_shortened(rates):
    class Growing(torch.optim.SGD):
        def step(self):  # type: ignore[override]
            super().step()
            param = self.param_groups[1]["params"][0]
            param.data = torch.cat([param.data, param.data])

    optimizer, _ = model([[1.0]] * 5)
    optimizer, failed = Growing(optimizer.param_groups, lr=RATE), []
    rates.on_error = failed.append
    rates.scale(3.0)
    for group in optimizer.param_groups:
        group["params"][0].grad = torch.zeros_like(group["params"][0])
    optimizer.step()
    assert len(failed) == 1 and all(group["lr"] == RATE for group in optimizer.param_groups)


def test_anchors_have_no_sizes(rates):
    optimizer, scales = model([[1000.0] * 6] * 5)
    rates.scale(3.0)
    assert step(optimizer, scales, 1.0).eq(TIMES).all()


def test_scales_without_positions_have_no_bound(rates):
    scales = torch.nn.Parameter(torch.full((5, 3), 9.0))
    optimizer = torch.optim.SGD([{"params": [scales], "name": "scaling"}], lr=RATE)
    rates.scale(3.0)
    assert step(optimizer, scales, 1.0).eq(TIMES).all()


@pytest.mark.parametrize("rows", [0, 1, 3])
def test_a_model_without_extent_has_no_bound(rows):
    bound, scales = SizeBound(), torch.full((rows, 3), 9.0)
    bound.measure(torch.ones(rows, 3))
    bound.shorten(scales, torch.zeros(rows, 3), 4.0)
    assert scales.eq(9.0).all() and bound.measured == (rows > 0)


def test_the_bound_goes_on_from_a_state():
    bound, other = SizeBound(), SizeBound()
    other.load_state_dict(bound.state_dict())
    assert not other.measured
    bound.measure(positions())
    other.load_state_dict(bound.state_dict())
    other.measure(positions() * 1000.0)
    assert other.state_dict() == bound.state_dict() == pytest.approx(BOUND)
    scales = torch.full((5, 1), BOUND + 1.0)
    other.shorten(scales, torch.full((5, 1), BOUND), 4.0)
    assert torch.allclose(scales, torch.tensor(BOUND + 0.25))


def test_numbers_that_are_not_finite_are_left_alone():
    bound, scales = SizeBound(), torch.tensor([-math.inf, math.nan, BOUND + 1.0])
    bound.measure(positions())
    bound.shorten(scales, torch.tensor([-math.inf, 0.0, BOUND]), 4.0)
    assert scales[0] == -math.inf and scales[1].isnan() and scales[2].item() == pytest.approx(BOUND + 0.25)
