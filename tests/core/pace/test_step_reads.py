"""Larger steps of optimizers that do not read the settings of their groups."""

import types

import pytest
import torch
from test_rates import parameter

from skipgs_plug.core.errors import SkipGSError

EXTENSION = types.ModuleType("extension")  # stands for an extension in CUDA


class Constant(torch.optim.Optimizer):
    """Its step reads no rate."""

    def step(self):
        for group in self.param_groups:
            group["params"][0].data -= 0.1


class Literal(torch.optim.Adam):
    """Passes literal betas to a function of its module, as the sparse Adam of accelerated rasterizers."""

    def step(self, visible, n):
        for group in self.param_groups:
            EXTENSION.update(group["params"][0], group["lr"], 0.9, 0.999, group["eps"], n)


class Buried(torch.optim.Adam):
    """Its betas cannot be reached from outside."""

    def step(self):
        for group in self.param_groups:
            group["params"][0].data -= group["lr"]


@pytest.fixture
def passed(monkeypatch):
    """Arguments that an extension was called with."""
    calls = []
    monkeypatch.setattr(EXTENSION, "update", lambda *args: calls.append(args), raising=False)
    return calls


@pytest.mark.parametrize("settings", [{}, {"lr": 0.1}], ids=["no rate", "a rate"])
def test_larger_steps_that_never_arrive_are_an_error(rates, settings):
    value = parameter()
    rates.scale(3.0)
    optimizer = Constant([value], settings)
    with pytest.raises(SkipGSError, match=r"Steps of Constant do not read the lr of its param_groups"):
        optimizer.step()
    assert type(optimizer.param_groups[0]) is dict and optimizer.param_groups[0].get("lr") == settings.get("lr")


def test_steps_that_are_not_larger_need_read_no_rate(rates):
    rates.scale(1.0)
    Constant([parameter()], {}).step()


def test_literal_betas_are_replaced_for_the_length_of_a_step(rates, passed):
    extension, value = EXTENSION, torch.nn.Parameter(torch.zeros(5, 3))
    value.grad = torch.ones(5, 3)
    optimizer = Literal([{"params": [value], "name": "xyz"}], lr=0.1)
    for _ in range(2):
        rates.scale(4.0)
        optimizer.step(True, 5)
        assert EXTENSION is extension
    rates.pause()
    optimizer.step(True, 5)
    assert [call[1:4] for call in passed] == [(0.8, 0.9, 0.98), (0.8, 0.9, 0.98), (0.1, 0.9, 0.999)]


def test_where_squares_are_kept_longer_steps_are_less_large(rates):
    value = torch.nn.Parameter(torch.zeros(5, 3))
    value.grad = torch.ones(5, 3)
    optimizer = Buried([{"params": [value], "name": "xyz"}], lr=0.1)
    rates.scale(4.0)
    with pytest.warns(RuntimeWarning, match=r"Steps of Buried do not read the betas .* raised 0\.22 times as far"):
        optimizer.step()
    moved = value.detach().clone()
    rates.scale(4.0)
    optimizer.step()
    torch.testing.assert_close(moved - value.detach(), torch.full((5, 3), 0.8 * 0.05**0.5))
