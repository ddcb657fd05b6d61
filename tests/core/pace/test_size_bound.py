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
    assert step(optimizer, 1.0).eq(TIMES).all()  # the largest one is at the bound
    rates.scale(3.0, growing)
    assert step(optimizer, 1.0)[:, 0].tolist() == [TIMES, TIMES, 1.0]
    # One axis beyond the bound is enough, and all axes of that Gaussian count.
    with torch.no_grad():
        scales[1, 2] = math.log(20.0)
    rates.scale(3.0, growing)
    moved = step(optimizer, 1.0)
    assert moved[0].eq(TIMES).all() and moved[1:].eq(1.0).all()


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
    # The first step is a whole one, and the others are shortened.
    assert scales.tolist() == [[1.0 + EVERY / 4.0] * 3] * rows


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
    assert scales.tolist() == [[1.0, pytest.approx(1.7)], [0.25, pytest.approx(1.05)]]


def test_numbers_that_are_not_finite_are_left_alone():
    bound, scales = SizeBound(), torch.tensor([[math.nan], [1.0]])
    before = bound.before(scales)
    scales += 1.0
    bound.after(scales, before, 4.0)
    assert scales[1].item() == 2.0 and math.isnan(scales[0].item())
