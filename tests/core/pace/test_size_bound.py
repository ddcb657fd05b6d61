"""Longer steps do not make the largest Gaussians larger still."""

import math

import pytest
import torch

from skipgs_plug.core.pace.parts import GrowingParts
from skipgs_plug.core.pace.size_bound import EVERY, LARGEST, SizeBound

TIMES = 6.0  # scales take twice the common factor of 3


def model(sizes):
    """Optimizer of positions and scales of Gaussians of these sizes, with a rate of 0.1."""
    scales = torch.tensor(sizes).log()[:, None].repeat(1, 3)
    groups = {"xyz": torch.zeros(len(sizes), 3), "scaling": scales}
    params = [{"params": [torch.nn.Parameter(value)], "name": name} for name, value in groups.items()]
    return torch.optim.SGD(params, lr=0.1), params[1]["params"][0]


def step(optimizer, direction):
    """Take a step in which all sizes grow (1) or shrink (-1), and return how far they went in units of the rate."""
    for group in optimizer.param_groups:
        group["params"][0].grad = torch.full_like(group["params"][0], -direction)
    scales = optimizer.param_groups[1]["params"][0]
    before = scales.detach().clone()
    optimizer.step()
    return ((scales.detach() - before) / (0.1 * direction)).round(decimals=3)


@pytest.mark.parametrize("growing", [None, GrowingParts(1.0, 2.0, 2.0)])
def test_sizes_beyond_the_largest_one_at_the_start_grow_as_in_the_trainers_own_steps(rates, growing):
    optimizer, scales = model([1.0, 2.0, 8.0])
    rates.scale(3.0, growing)
    assert step(optimizer, 1.0)[:, 0].tolist() == [TIMES, TIMES, 1.0]
    with torch.no_grad():
        scales[1] = torch.tensor([0.0, 20.0, 7.999]).log()
    rates.scale(3.0, growing)
    moved = step(optimizer, 1.0)
    assert moved[0].eq(TIMES).all() and moved[2].eq(1.0).all()
    assert moved[1, 1] == 1.0  # one axis of a Gaussian
    assert scales[1, 2].item() == pytest.approx(math.log(7.999) + 0.1)  # a longer step takes none beyond the bound


def test_large_sizes_shrink_in_longer_steps(rates):
    optimizer, _ = model([1.0, 8.0])
    rates.scale(3.0)
    step(optimizer, 1.0)
    rates.scale(3.0)
    assert step(optimizer, -1.0).eq(TIMES).all()


def test_growing_phases_that_are_not_bounded_leave_all_sizes_alone(rates):
    optimizer, _ = model([1.0, 8.0])
    for _ in range(3):
        rates.scale(3.0, GrowingParts(1.0, 2.0, 2.0, bounded=False))
        assert step(optimizer, 1.0).eq(TIMES).all()
    assert rates.sizes.state_dict() == [0.0, 0]


def test_steps_that_are_not_longer_are_the_trainers_own(rates):
    optimizer, _ = model([1.0, 8.0])
    rates.scale(3.0)
    step(optimizer, 1.0)
    rates.scale(0.25)
    assert step(optimizer, 1.0).eq(0.5).all()


def test_a_hundredth_of_the_gaussians_may_be_larger():
    bound, sizes = SizeBound(), torch.zeros(4000, 3)
    for _ in range(EVERY):
        bound.before(sizes)
    assert bound.state_dict() == [0.0, EVERY]
    sizes = torch.linspace(0.0, 4.0, 4000)[:, None].repeat(1, 3)
    bound.before(sizes)
    above = (sizes[:, 0] > bound.state_dict()[0]).sum().item()
    assert above == 4000 * LARGEST - 1
    for _ in range(EVERY):  # it never falls
        bound.before(torch.zeros(4000, 3))
    assert (sizes[:, 0] > bound.state_dict()[0]).sum().item() == above


@pytest.mark.parametrize("rows", [0, 1])
def test_a_model_of_few_gaussians(rows):
    bound, scales = SizeBound(), torch.zeros(rows, 3)
    for _ in range(EVERY + 1):
        before = bound.before(scales)
        scales += 1.0
        bound.after(scales, before, 4.0)
    assert scales.tolist() == [[(EVERY + 1) / 4.0] * 3] * rows


def test_the_bound_goes_on_from_a_state():
    bound = SizeBound()
    bound.before(torch.tensor([[0.1, 0.7]]))
    other = SizeBound()
    other.load_state_dict(bound.state_dict())
    assert other.state_dict() == bound.state_dict() == [pytest.approx(0.7), 1]
    scales = torch.tensor([[0.0, 0.7], [0.0, 0.8]])
    before = other.before(scales)
    scales += 1.0
    other.after(scales, before, 4.0)
    assert scales.tolist() == [[pytest.approx(0.7), pytest.approx(0.95)], [pytest.approx(0.7), pytest.approx(1.05)]]


def test_numbers_that_are_not_finite_are_left_alone():
    bound, scales = SizeBound(), torch.tensor([[-math.inf, 1.0]])
    before = bound.before(scales)
    scales += 1.0
    scales = torch.cat([scales, torch.full((1, 2), math.nan)])
    bound.after(scales, torch.cat([before, torch.zeros(1, 2)]), 4.0)
    assert scales[0].tolist() == [-math.inf, 1.25] and scales[1].isnan().all()


def test_anchors_have_no_sizes(rates):
    optimizer = torch.optim.SGD([{"params": [torch.nn.Parameter(torch.zeros(4, 6))], "name": "scaling"}], lr=0.1)
    (param,) = optimizer.param_groups[0]["params"]
    for _ in range(2):
        rates.scale(3.0)
        param.grad = -torch.ones_like(param)
        optimizer.step()
    assert rates.sizes.state_dict() == [0.0, 0] and param.eq(0.2 * TIMES).all()
