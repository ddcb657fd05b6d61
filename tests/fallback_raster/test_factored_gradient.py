"""Torch treats a gradient in factors as the dense tensor that it represents."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from skipgs_plug.fallback_raster.oracle.torch_reference_projection import spherical_harmonics
from skipgs_plug.fallback_raster.runtime.constants import FACTOR_FLOATS
from skipgs_plug.fallback_raster.training.adam import adam_step
from skipgs_plug.fallback_raster.training.factored_gradient import FactoredGradient, Factors
from skipgs_plug.fallback_raster.training.optimizer import Adam

SHAPE = torch.Size((7, 15, 3))


def some(seed: int = 0, degree: int = 3) -> FactoredGradient:
    generator = torch.Generator().manual_seed(seed)
    rows = torch.tensor([1, 2, 5], dtype=torch.int32)
    directions, colors = torch.randn(2, 3, FACTOR_FLOATS, generator=generator)
    directions[:, :3] /= directions[:, :3].norm(dim=1, keepdim=True)
    colors[1, :3] = 0.0
    directions[1] = torch.nan
    return FactoredGradient(SHAPE, [Factors(rows, directions, colors, degree)])


class Given(torch.autograd.Function):
    """The sum of `x`, with `gradient` as its gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, gradient: Tensor) -> Tensor:  # type: ignore[override]
        ctx.gradient = gradient
        return x.sum()

    @staticmethod
    def backward(ctx: Any, v: Tensor) -> Any:  # type: ignore[override]
        return ctx.gradient.clone(), None


def parameter() -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.randn(SHAPE, generator=torch.Generator().manual_seed(9)))


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_products_of_the_rows_and_zeros_elsewhere(degree: int) -> None:
    gradient = some(degree=degree)
    assert gradient.factors is not None
    rows, directions, colors, _ = gradient.factors
    coefficients = torch.zeros(len(rows), 16, 3, dtype=torch.float64, requires_grad=True)
    shown = spherical_harmonics(degree, directions[:, :3].double(), coefficients)
    expected = torch.zeros(SHAPE, dtype=torch.float64)
    (product,) = torch.autograd.grad(shown, coefficients, colors[:, :3].double())
    expected[rows.long()] = torch.where((colors[:, :3] != 0).any(1)[:, None, None], product[:, 1:], 0.0)
    torch.testing.assert_close(gradient.dense(), expected.float(), rtol=1e-6, atol=1e-6)
    assert not gradient.dense()[:, (degree + 1) ** 2 - 1 :].any() and expected.any()
    assert gradient.shape == SHAPE and gradient.dtype is torch.float32 and gradient.is_contiguous()


def test_whatever_the_default_type_of_the_process() -> None:
    gradient = some()
    torch.set_default_dtype(torch.float64)
    try:
        found = gradient.dense()
    finally:
        torch.set_default_dtype(torch.float32)
    assert found.dtype is torch.float32


@pytest.mark.parametrize(
    "operation",
    [
        lambda g: g * 2,
        lambda g: 1 - g,
        lambda g: g.norm(),
        lambda g: g[1:3],
        lambda g: g.index_select(0, torch.tensor([5, 1])),
        lambda g: torch.stack([g, g]),
        lambda g: torch.zeros(SHAPE).add_(g),
        lambda g: torch.isfinite(g).all(),
        lambda g: torch.lerp(torch.ones(SHAPE), g, 0.5),
    ],
)
def test_operations_see_the_dense_tensor_and_leave_the_factors(operation: Callable[[Tensor], Tensor]) -> None:
    gradient = some()
    found = operation(gradient)
    assert type(found) is Tensor and torch.equal(found, operation(gradient.dense()))
    assert gradient.factors is not None


@pytest.mark.parametrize("change", [lambda g: g.mul_(3), lambda g: g.zero_(), lambda g: g.add_(torch.ones(SHAPE))])
def test_what_changes_it_in_place_lasts(change: Callable[[Tensor], Tensor]) -> None:
    gradient, copied = some(), some().clone()
    before, alias = gradient.dense(), gradient.detach()
    assert change(alias) is alias
    assert gradient.factors is None and torch.equal(gradient.dense(), change(before))
    assert torch.equal(gradient + 0, before)
    assert isinstance(copied, FactoredGradient) and torch.equal(copied.dense(), some().dense())


def test_autograd_hands_it_on_and_adds_others_to_it() -> None:
    param = parameter()
    Given.apply(param, some()).backward()
    assert isinstance(param.grad, FactoredGradient) and param.grad.factors is not None
    for other in (some(1), torch.ones(SHAPE), some(2)):
        expected = param.grad + other
        Given.apply(param, other).backward()
        assert param.grad is not None and torch.equal(param.grad + 0, expected)
    torch.nn.utils.clip_grad_norm_([param], 0.1)
    assert param.grad.norm() == pytest.approx(0.1, rel=1e-5)


@pytest.mark.parametrize("optimizer", [Adam, torch.optim.Adam, torch.optim.SGD])
def test_any_optimizer_steps_with_it(optimizer: type[torch.optim.Optimizer]) -> None:
    found = []
    for gradient in (some(), some().dense()):
        param = parameter()
        param.grad = gradient
        optimizer([param], lr=0.1).step()  # type: ignore[call-arg]
        found.append(param.detach())
    torch.testing.assert_close(found[0], found[1], rtol=1e-6, atol=1e-7)


def test_a_kernel_refuses_it() -> None:
    values, mean, square = (torch.zeros(SHAPE) for _ in range(3))
    with pytest.raises(TypeError, match="gradient must be a contiguous tensor"):
        adam_step(None, values, some(), mean, square, 0.1, 1.0, (0.9, 0.999), 1e-8)
