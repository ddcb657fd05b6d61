"""The share of Gaussians that a view shows, read off gradients."""

import math

import pytest
import torch

from skipgs_plug.core.pace.parts import GroupInfo
from skipgs_plug.core.pace.rates import ScaledRates, path_factor
from skipgs_plug.core.pace.visibility import ROWS, STEPS, Visibility, visible_share


def positions(rows, reached, width=3):
    value = torch.nn.Parameter(torch.zeros(rows, width))
    value.grad = torch.zeros(rows, width)
    value.grad[torch.randperm(rows)[:reached], torch.randint(width, (reached,))] = torch.randn(reached)
    return value


def see(visibility, groups, name=None):
    visibility.see([param for group in groups for param in GroupInfo(group, name).positions])


@pytest.mark.parametrize("rows, reached", [(40, 10), (40, 40), (1, 1), (7, 3)])
def test_rows_with_a_gradient_count(rows, reached):
    gradient = positions(rows, reached).grad
    assert visible_share(gradient) == reached / rows
    assert visible_share(gradient.to_sparse(1)) == reached / rows
    assert visible_share(gradient.to_sparse(2)) == reached / rows


def test_rows_listed_with_zeros_do_not_count():
    values = torch.tensor([[0.0, 0.0], [0.0, 2.0], [1.0, 0.0]])
    listed = torch.sparse_coo_tensor(torch.tensor([[1, 4, 4]]), values, (10, 2), check_invariants=True)
    assert visible_share(listed) == 0.1


def test_of_many_rows_some_are_looked_at():
    assert visible_share(positions(20 * ROWS, 6 * ROWS).grad) == pytest.approx(0.3, abs=0.03)


def test_the_mean_over_the_first_steps_counts():
    visibility = Visibility()
    assert visibility.visible is None
    for step in range(2 * STEPS):
        reached = 10 if step < STEPS else 40
        see(visibility, [{"name": "rotation", "params": [positions(40, 20, 4)]}])
        see(visibility, [{"name": "xyz", "params": [positions(40, reached)]}])
    assert visibility.visible == 0.25
    again = Visibility()
    again.load_state_dict(visibility.state_dict())
    assert again.visible == visibility.visible


@pytest.mark.parametrize(
    "group, name, expected",
    [
        ({"name": "means"}, None, 0.5),
        ({}, "means", 0.5),
        ({}, None, 0.5),
        ({"name": "scaling"}, None, None),  # a regulariser may fill it
        ({}, "scales", None),
        ({"name": "anchor"}, "means", None),
    ],
)
def test_positions_are_known_by_name_or_by_shape(group, name, expected):
    visibility = Visibility()
    see(visibility, [{"params": [positions(40, 40, 1)]}, {"params": [positions(40, 20)], **group}], name)
    assert visibility.visible == expected


def test_parameters_without_a_gradient_do_not_count():
    visibility = Visibility()
    empty = torch.nn.Parameter(torch.zeros(40, 3))
    for _ in range(3):
        visibility.see([empty])
        visibility.see([positions(40, 0)])
        visibility.see([positions(0, 0)])
    assert visibility.visible is None
    visibility.see([positions(40, 30)])
    assert visibility.visible == 0.75


def test_steps_are_longer_where_a_view_shows_more():
    rates = ScaledRates()
    value = positions(40, 36)
    optimizer = torch.optim.SGD([{"params": [value], "name": "xyz"}], lr=0.1)
    rates.scale(1.0)
    optimizer.step()
    rates.remove()
    assert path_factor(0.4, 0.25, visible=rates.visibility.visible) == pytest.approx(3.75 * math.sqrt(2.7))
    assert path_factor(0.4, 0.25) == pytest.approx(3.75)
    assert path_factor(0.4, 0.25, peak=3.0, visible=0.9) == 2.25


def test_other_optimizers_are_not_looked_at():
    own, other = (torch.optim.SGD([positions(40, reached)], lr=0.1) for reached in (10, 40))
    rates = ScaledRates(lambda: {"means": own})
    rates.scale(1.0)
    other.step()
    own.step()
    rates.pause()
    own.step()
    rates.remove()
    assert rates.visibility.state_dict() == [0.25, 1, 1, 0, 0]
