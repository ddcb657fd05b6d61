"""Rows that catch up with missed steps equal to the bit those of Adam with zero gradients, whenever they do so."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from skipgs_plug.core.pace.rates import ScaledRates
from skipgs_plug.fallback_raster import get_num_threads, set_num_threads
from skipgs_plug.fallback_raster.runtime.constants import FACTOR_FLOATS
from skipgs_plug.fallback_raster.training.factored_gradient import FactoredGradient, Factors
from skipgs_plug.fallback_raster.training.lazy_adam import MAX_MISSED_STEPS, LazyAdam
from skipgs_plug.fallback_raster.training.optimizer import Adam

EPS = 1e-15
SHAPES = [(60, 15, 3), (60, 8, 3), (60, 3, 3), (60, 1, 3), (1, 15, 3), (60, 6, 3)]


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    before = get_num_threads()
    yield set_num_threads
    set_num_threads(before)


def parameter(shape: tuple[int, ...], generator: torch.Generator) -> torch.nn.Parameter:
    """A parameter with zeros, one of which is negative."""
    values = 0.03 * torch.randn(shape, generator=generator)
    values[torch.rand(shape, generator=generator) < 0.05] = 0.0
    values.view(-1)[0] = -0.0
    return torch.nn.Parameter(values)


def gradient(shape: tuple[int, ...], share: float, generator: torch.Generator) -> FactoredGradient:
    """Gradients for a share of the rows, of very different sizes, zero in some elements and in some rows."""
    rows = torch.nonzero(torch.rand(shape[0], generator=generator) < share)[:, 0].to(torch.int32)
    directions = torch.randn(len(rows), FACTOR_FLOATS, generator=generator)
    directions[torch.rand(directions.shape, generator=generator) < 0.2] = 0.0
    directions /= directions[:, :3].norm(dim=1, keepdim=True)
    colors = torch.randn(len(rows), FACTOR_FLOATS, generator=generator)
    colors *= 10.0 ** torch.randint(-14, 4, (len(rows), 1), generator=generator)
    nothing = torch.rand(len(rows), generator=generator) < 0.2
    colors[nothing | directions.isnan().any(1), :3] = 0.0
    directions[nothing] = torch.nan  # the kernels leave these undefined
    degree = int(torch.randint(1, 4, (), generator=generator))
    return FactoredGradient(torch.Size(shape), [Factors(rows, directions, colors, degree)])


def assert_equal(lazy: LazyAdam, dense: Adam) -> None:
    (one,), (other,) = lazy.param_groups[0]["params"], dense.param_groups[0]["params"]
    assert torch.equal(one.view(torch.int32), other.view(torch.int32))
    for name, moment in dense.state[other].items():
        assert torch.equal(lazy.state[one][name].view(torch.int32), moment.view(torch.int32)), name


def train(
    shape: tuple[int, ...],
    steps: int,
    share: float,
    rates: Callable[[int], float] = lambda _: 1.25e-4,
    before: Callable[[int, LazyAdam, Tensor], Any] = lambda *_: None,
    seed: int = 0,
    **options: Any,
) -> tuple[LazyAdam, Adam]:
    """Return both parameters after the same steps. `before` is called with each step and the rows of its gradient."""
    generator = torch.Generator().manual_seed(seed)
    one = parameter(shape, generator)
    other = torch.nn.Parameter(one.detach().clone())
    lazy, dense = LazyAdam([one], eps=EPS, **options), Adam([other], eps=EPS, **options)
    for step in range(steps):
        one.grad = gradient(shape, share, generator)
        other.grad = one.grad.dense()
        before(step, lazy, one.grad.factors.rows)
        for optimizer in (lazy, dense):
            optimizer.param_groups[0]["lr"] = rates(step)
            optimizer.step()
    return lazy, dense


@pytest.mark.parametrize("share", [0.9, 0.3, 0.02])
@pytest.mark.parametrize("shape", SHAPES)
def test_caught_up_at_the_end_it_is_adam(shape: tuple[int, ...], share: float) -> None:
    lazy, dense = train(shape, 150, share)
    if share < 0.9 and shape[0] > 1:
        (one,), (other,) = lazy.param_groups[0]["params"], dense.param_groups[0]["params"]
        assert not torch.equal(one, other)  # rows are behind
    lazy.catch_up()
    assert_equal(lazy, dense)


@pytest.mark.parametrize(
    "rates",
    [
        lambda step: 1.25e-4 * 40 * (1 - step / 300),
        lambda step: 0.0 if step % 3 else 1e-3,
        lambda step: 10.0 ** (step % 40 - 30),
    ],
    ids=["falling", "sometimes zero", "of all sizes"],
)
def test_rates_are_those_of_the_missed_steps(rates: Callable[[int], float]) -> None:
    lazy, dense = train(SHAPES[0], 300, 0.05, rates)
    lazy.catch_up()
    assert_equal(lazy, dense)


@pytest.mark.parametrize("betas", [(0.0, 0.999), (0.9, 0.5), (0.999, 0.99999)])
def test_other_decays(betas: tuple[float, float]) -> None:
    lazy, dense = train(SHAPES[0], 200, 0.05, betas=betas)
    lazy.catch_up()
    assert_equal(lazy, dense)


def test_scaled_rates_reach_missed_steps() -> None:
    scaled = ScaledRates()
    try:

        def before(step: int, lazy: LazyAdam, rows: Tensor) -> None:
            if step >= 50:
                scaled.scale(10.0 * (1 - step / 200))

        lazy, dense = train(SHAPES[0], 200, 0.1, before=before)
    finally:
        scaled.remove()
    lazy.catch_up()
    assert_equal(lazy, dense)


def test_it_does_not_matter_when_and_for_which_rows() -> None:
    generator = torch.Generator().manual_seed(5)

    def before(step: int, lazy: LazyAdam, rows: Tensor) -> None:
        if step % 7 == 3:
            lazy.catch_up()
        elif step % 2:
            lazy.catch_up(torch.randperm(60, generator=generator)[:20].to(torch.int32))
        else:
            lazy.catch_up(rows)

    lazy, dense = train(SHAPES[0], 150, 0.1, before=before)
    lazy.catch_up()
    assert_equal(lazy, dense)


def test_rows_that_are_asked_for_are_up_to_date() -> None:
    generator = torch.Generator().manual_seed(6)
    lazy, dense = train(SHAPES[0], 60, 0.1)
    rows = torch.randperm(60, generator=generator)[:20].to(torch.int32)
    lazy.catch_up(rows)
    (one,), (other,) = lazy.param_groups[0]["params"], dense.param_groups[0]["params"]
    assert torch.equal(one[rows], other[rows]) and not torch.equal(one, other)
    for name in ("exp_avg", "exp_avg_sq"):
        assert torch.equal(lazy.state[one][name][rows], dense.state[other][name][rows])


def test_more_steps_than_it_keeps_rates_of() -> None:
    lazy, dense = train((7, 15, 3), 2 * MAX_MISSED_STEPS + 10, 0.002)
    lazy.catch_up()
    assert_equal(lazy, dense)


def test_any_number_of_threads_gives_the_same_bits(threads: Callable[[int], None]) -> None:
    found = []
    for count in (1, 2, 5):
        threads(count)
        lazy, _ = train((2000, 15, 3), 12, 0.3)
        lazy.catch_up()
        found.append(lazy.param_groups[0]["params"][0].detach())
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


def test_gradients_may_be_added_up_or_dense_or_missing() -> None:
    generator = torch.Generator().manual_seed(7)
    shape = SHAPES[0]
    one = parameter(shape, generator)
    other = torch.nn.Parameter(one.detach().clone())
    lazy, dense = LazyAdam([one], eps=EPS), Adam([other], eps=EPS)
    for step in range(60):
        parts = [gradient(shape, 0.2, generator) for _ in range(1 + step % 3)]
        if step % 5 == 4:
            parts.append(torch.randn(shape, generator=generator))
        for part in parts:
            plain = part.dense() if isinstance(part, FactoredGradient) else part
            one.grad = part if one.grad is None else part + one.grad
            other.grad = plain if other.grad is None else other.grad + plain
        if step % 4 == 3:
            one.grad = other.grad = None
        for optimizer in (lazy, dense):
            optimizer.step()
            optimizer.zero_grad()
    lazy.catch_up()
    assert_equal(lazy, dense)


def test_its_state_dict_is_adams() -> None:
    lazy, dense = train(SHAPES[0], 40, 0.1)
    found, truth = lazy.state_dict()["state"][0], dense.state_dict()["state"][0]
    assert found.keys() == truth.keys() and all(torch.equal(found[name], truth[name]) for name in truth)
    (one,) = lazy.param_groups[0]["params"]
    other = LazyAdam([torch.nn.Parameter(one.detach().clone())], eps=EPS)
    other.load_state_dict(copy.deepcopy(lazy.state_dict()))
    generator = torch.Generator().manual_seed(8)
    for _ in range(10):
        grad = gradient(SHAPES[0], 0.1, generator)
        for optimizer in (lazy, other):
            optimizer.param_groups[0]["params"][0].grad = grad
            optimizer.step()
    other.catch_up()
    lazy.catch_up()
    assert_equal(lazy, other)


@pytest.mark.filterwarnings("ignore:You are using `torch.load`:FutureWarning")  # torch 2.4 warns so when it unpickles
@pytest.mark.parametrize("again", [copy.deepcopy, lambda lazy: pickle.loads(pickle.dumps(lazy))])
def test_a_copy_goes_on_as_the_original(again: Callable[[LazyAdam], LazyAdam]) -> None:
    generator = torch.Generator().manual_seed(4)
    param = parameter((60, 15, 3), generator)
    lazy = LazyAdam([param], eps=EPS)
    gradients = [gradient((60, 15, 3), 0.3, generator) for _ in range(8)]

    def steps(optimizer: LazyAdam, some: list[Tensor]) -> Tensor:
        (own,) = optimizer.param_groups[0]["params"]
        for each in some:
            own.grad = each
            optimizer.step()
        optimizer.catch_up()
        return own.detach()

    for each in gradients[:4]:
        param.grad = each
        lazy.step()
    other = again(lazy)
    assert other.param_groups[0]["params"][0] is not param
    before = param.detach().clone()
    after = steps(other, gradients[4:])
    assert torch.equal(param, before)
    assert torch.equal(steps(lazy, gradients[4:]).view(torch.int32), after.view(torch.int32))


@pytest.mark.parametrize(
    "params",
    [
        [torch.zeros(3, 17, 3)],
        [torch.zeros(3, 0, 3)],
        [torch.zeros(3, 4)],
        [torch.zeros(3, 4, 4)],
        [torch.zeros(3, 4, 3), torch.zeros(3, 4, 3)],
        [torch.zeros(3, 4, 3, dtype=torch.float64)],
        [torch.zeros(3, 4, 3).transpose(0, 2)],
    ],
)
def test_parameters_that_it_does_not_take(params: list[Tensor]) -> None:
    with pytest.raises(ValueError, match=r"one contiguous float32 parameter .* use Adam"):
        LazyAdam([torch.nn.Parameter(param) for param in params], eps=EPS)


def test_eps_must_not_be_zero() -> None:
    with pytest.raises(ValueError, match="eps > 0"):
        LazyAdam([torch.nn.Parameter(torch.zeros(3, 4, 3))], eps=0.0)


def test_a_parameter_replaced_while_rows_are_behind_is_an_error() -> None:
    lazy, _ = train(SHAPES[0], 3, 0.1)
    new = lazy.param_groups[0]["params"][0] = torch.nn.Parameter(torch.zeros(4, 15, 3))
    with pytest.raises(RuntimeError, match=r"call catch_up\(\) before"):
        lazy.catch_up()
    new.grad = gradient((4, 15, 3), 0.9, torch.Generator().manual_seed(0))
    with pytest.raises(RuntimeError, match=r"call catch_up\(\) before"):
        lazy.step()
