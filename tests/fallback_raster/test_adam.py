"""Adam for visible rows against the same formula in float64."""

from __future__ import annotations

import pytest
import torch

from skipgs_plug.fallback_raster.training.adam import adam_rows


@pytest.mark.parametrize("shape", [(1,), (700, 1), (700, 3), (1300, 15, 3), (0, 3)])
def test_rows_follow_adam_without_bias_correction(shape: tuple[int, ...]) -> None:
    values, mean, gradient = torch.randn(3, *shape)
    square = torch.rand(shape)
    seen = torch.rand(shape[0]) < 0.5
    param = torch.nn.Parameter(values.clone())
    param.grad = gradient
    truth = [t.double() for t in (values, mean, square)]
    rows = torch.nonzero(seen)[:, 0]
    g = gradient.double()[rows]
    truth[1][rows] = 0.9 * truth[1][rows] + 0.1 * g
    truth[2][rows] = 0.999 * truth[2][rows] + 0.001 * g**2
    truth[0][rows] -= 0.01 * truth[1][rows] / (truth[2][rows].sqrt() + 1e-15)
    kept = [t.clone() for t in (values, mean, square)]
    adam_rows(seen, param, mean, square, 0.01, (0.9, 0.999), 1e-15)
    for found, exact, before in zip((param.data, mean, square), truth, kept, strict=True):
        torch.testing.assert_close(found.double(), exact, rtol=1e-5, atol=1e-6)
        assert torch.equal(found[~seen], before[~seen])


def test_a_transposed_parameter_is_updated_like_its_copy() -> None:
    values, gradient = torch.randn(2, 50, 3, 15)
    results = []
    for order in (lambda t: t.transpose(1, 2), lambda t: t.transpose(1, 2).contiguous()):
        param = torch.nn.Parameter(order(values.clone()))
        param.grad = order(gradient)
        mean, square = torch.zeros_like(param), torch.zeros_like(param)
        adam_rows(torch.rand(50, generator=torch.manual_seed(0)) < 0.5, param, mean, square, 0.1, (0.9, 0.999), 1e-15)
        results.append(torch.stack([param.data, mean, square]))
    assert torch.equal(*results)
    assert not torch.equal(results[0][0], values.transpose(1, 2))


def test_a_row_without_gradient_stays() -> None:
    param = torch.nn.Parameter(torch.ones(2, 3))
    param.grad = torch.zeros(2, 3)
    adam_rows(torch.tensor([True, True]), param, torch.zeros(2, 3), torch.zeros(2, 3), 0.1, (0.9, 0.999), 1e-15)
    assert (param == 1).all()
