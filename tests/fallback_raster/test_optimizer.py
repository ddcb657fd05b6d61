"""Adam on all cores, compared with its formula and with torch's Adam, as a class and in place of torch's function."""

from __future__ import annotations

import copy
import importlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.optim.optimizer import register_optimizer_step_post_hook, register_optimizer_step_pre_hook

from skipgs_plug.fallback_raster import get_num_threads, set_num_threads
from skipgs_plug.fallback_raster.training.optimizer import Adam, instead_of_torchs_adam

SHAPES = [(1,), (16,), (33, 3), (700, 15, 3), (0, 3), (40_001,)]
# Torch's own implementations, which differ by an ulp of a step.
TORCHS = {"default": {"foreach": False}, "foreach": {"foreach": True}, "fused": {"fused": True}}
LEFT_TO_TORCH: dict[str, dict[str, Any]] = {
    "weight decay": {"weight_decay": 0.1},
    "amsgrad": {"amsgrad": True},
    "maximize": {"maximize": True},
}


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    before = get_num_threads()
    yield set_num_threads
    set_num_threads(before)


def gradients(shape: tuple[int, ...], seed: int, steps: int) -> list[Tensor]:
    """Gradients of very different sizes, half of them zero."""
    generator = torch.Generator().manual_seed(seed)

    def random() -> Tensor:
        size = 10.0 ** torch.randint(-9, 3, shape, generator=generator)
        some = torch.rand(shape, generator=generator) < 0.5
        return torch.randn(shape, generator=generator) * size * some

    return [random() for _ in range(steps)]


def parameter(shape: tuple[int, ...]) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.randn(shape, generator=torch.Generator().manual_seed(0)))


def train(optimizer: torch.optim.Optimizer, grads: list[Tensor], rates: Callable[[int], float] | None = None) -> Any:
    """Return parameter and moments after a step with each gradient."""
    group = optimizer.param_groups[0]
    (param,) = group["params"]
    for number, grad in enumerate(grads):
        if rates is not None:
            group["lr"] = rates(number)
        param.grad = grad.clone()
        optimizer.step()
    state = optimizer.state[param]
    return param.detach(), state["exp_avg"], state["exp_avg_sq"]


def formula(values: Tensor, grads: list[Tensor], rates: Callable[[int], float], eps: float) -> list[Tensor]:
    """Adam in float32, each mean with one multiply-add that rounds once."""
    f, wide = np.float32, np.float64
    x, m, s = values.numpy().copy(), np.zeros(values.shape, f), np.zeros(values.shape, f)
    for number, grad in enumerate(grads):
        g, t = grad.numpy(), number + 1
        # The product of two floats is exact in float64, so this rounds as a multiply-add does.
        m = (m.astype(wide) + wide(f(1 - 0.9)) * (g - m).astype(wide)).astype(f)
        s = ((f(0.999) * s).astype(wide) + (f(1 - 0.999) * g).astype(wide) * g.astype(wide)).astype(f)
        m[np.abs(m) < np.finfo(f).tiny] = 0
        rate, root = f(rates(number) / (1 - 0.9**t)), f((1 - 0.999**t) ** 0.5)
        x = x + -rate * m / (np.sqrt(s) / root + f(eps))
    return [torch.from_numpy(np.asarray(a)) for a in (x, m, s)]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("shape", SHAPES)
def test_every_bit_is_that_of_the_formula(shape: tuple[int, ...], seed: int) -> None:
    grads = gradients(shape, seed, 40)
    found = train(Adam([parameter(shape)], eps=1e-15), grads, rates=lambda step: 0.01 * 0.98**step)
    exact = formula(parameter(shape).detach(), grads, lambda step: 0.01 * 0.98**step, 1e-15)
    for name, a, b in zip(("value", "mean", "square"), found, exact, strict=True):
        assert torch.equal(a, b), f"{int((a != b).sum())} of {a.numel()} differ in {name}"


@pytest.mark.parametrize("options", TORCHS.values(), ids=TORCHS)
def test_torchs_own_are_a_few_roundings_away(options: dict[str, Any]) -> None:
    grads = gradients((5000, 3), 1, 60)
    torchs = train(torch.optim.Adam([parameter((5000, 3))], lr=0.01, eps=1e-15, **options), grads)
    ours = train(Adam([parameter((5000, 3))], lr=0.01, eps=1e-15), grads)
    for a, b in zip(ours, torchs, strict=True):
        # The number of differences, from none to half, depends on the vector instructions that torch uses.
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-6)


def test_any_number_of_threads_gives_the_same_bits(threads: Callable[[int], None]) -> None:
    results = []
    for count in (1, 2, 5):
        threads(count)
        results.append(train(Adam([parameter((90_001,))]), gradients((90_001,), 2, 3)))
    for result in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(result, results[0], strict=True))


@pytest.mark.parametrize("first", [Adam, torch.optim.Adam])
def test_state_dicts_go_either_way(first: type[torch.optim.Adam]) -> None:
    grads = gradients((300, 3), 3, 20)
    whole = train(Adam([parameter((300, 3))], lr=0.02), grads)
    then = torch.optim.Adam if first is Adam else Adam
    one = first([parameter((300, 3))], lr=0.02)
    train(one, grads[:10])
    other = then([one.param_groups[0]["params"][0]])
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    assert other.state_dict().keys() == one.state_dict().keys()
    assert other.param_groups[0].keys() == one.param_groups[0].keys()
    for a, b in zip(train(other, grads[10:]), whole, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-7)


def test_interrupted_and_resumed_is_uninterrupted_to_the_bit() -> None:
    grads = gradients((300, 3), 4, 20)
    whole = train(Adam([parameter((300, 3))]), grads)
    one = Adam([parameter((300, 3))])
    train(one, grads[:7])
    other = Adam([torch.nn.Parameter(one.param_groups[0]["params"][0].detach().clone())])
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    assert all(torch.equal(a, b) for a, b in zip(train(other, grads[7:]), whole, strict=True))


@pytest.mark.parametrize("options", LEFT_TO_TORCH.values(), ids=LEFT_TO_TORCH)
def test_what_the_kernel_does_not_know_is_torchs_own(options: dict[str, Any]) -> None:
    grads = gradients((50, 3), 5, 8)
    theirs = train(torch.optim.Adam([parameter((50, 3))], **copy.deepcopy(options)), grads)
    ours = train(Adam([parameter((50, 3))], **copy.deepcopy(options)), grads)
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_differentiable_steps_are_torchs_own() -> None:
    results = []
    for kind in (Adam, torch.optim.Adam):
        leaf = torch.ones(3, requires_grad=True)
        param = leaf * 2
        param.retain_grad()
        optimizer = kind([param], differentiable=True)
        param.grad = torch.ones(3)
        optimizer.step()
        param.sum().backward()
        results.append((param.detach(), leaf.grad))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    assert results[0][1] is not None


def test_options_that_a_state_dict_brings_are_obeyed() -> None:
    saved = torch.optim.Adam([parameter((5, 3))], weight_decay=0.5).state_dict()
    grads = gradients((5, 3), 6, 3)
    optimizers = Adam([parameter((5, 3))]), torch.optim.Adam([parameter((5, 3))])
    for optimizer in optimizers:
        optimizer.load_state_dict(copy.deepcopy(saved))
    ours, theirs = (train(optimizer, grads) for optimizer in optimizers)
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


@pytest.mark.parametrize("make", [torch.Tensor.double, torch.Tensor.half, torch.Tensor.t], ids=["double", "half", "T"])
def test_other_tensors_in_a_group_are_torchs_own(make: Callable[[Tensor], Tensor]) -> None:
    values, grad = torch.randn(2, 40, 3)
    results = []
    for kind in (Adam, torch.optim.Adam):
        plain, other, still = (torch.nn.Parameter(t.clone()) for t in (values, make(values), values))
        optimizer = kind([plain, still, other], lr=0.1)
        for _ in range(3):
            plain.grad, other.grad = grad.clone(), make(grad.clone())
            optimizer.step()
        assert torch.equal(still, values) and still not in optimizer.state
        results.append((plain, other))
    (plain, other), (torchs_plain, torchs_other) = results
    assert torch.equal(other, torchs_other) and not torch.equal(other, make(values))
    torch.testing.assert_close(plain, torchs_plain, rtol=1e-6, atol=1e-6)


def test_nan_and_infinite_gradients_do_what_they_do_to_torch() -> None:
    grad = torch.tensor([torch.nan, torch.inf, -torch.inf, 1.0, 0.0] * 7)
    results = []
    for kind in (Adam, torch.optim.Adam):
        results.append(train(kind([torch.nn.Parameter(torch.ones(35))]), [grad, torch.ones(35)]))
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a, b, equal_nan=True)
    assert results[0][0].isnan().sum() == 21


def test_a_mean_that_fades_out_becomes_zero() -> None:
    grads = [torch.full((20,), 1e-3), *[torch.zeros(20)] * 900]
    value, mean, square = train(Adam([parameter((20,))]), grads)
    torchs, small, _ = train(torch.optim.Adam([parameter((20,))], fused=True), grads)
    assert not mean.any() and (small != 0).all() and (small.abs() < 1.2e-38).all() and (square > 0).all()
    torch.testing.assert_close(value, torchs, rtol=1e-6, atol=1e-6)


def test_hooks_see_every_step_once_and_may_change_the_rate() -> None:
    seen = []

    def double(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        optimizer.param_groups[0]["lr"] *= 2
        seen.append("before")

    grads = gradients((30,), 7, 4)
    hooked, plain = Adam([parameter((30,))], lr=0.01), Adam([parameter((30,))], lr=0.01)
    torch.optim.Adam([parameter((30,))])  # torch wraps `step` of the base class in the constructor
    hooked.register_step_pre_hook(double)
    hooked.register_step_post_hook(lambda *_: seen.append("after"))
    ours = train(hooked, grads)
    doubled = train(plain, grads, rates=lambda step: 0.02 * 2**step)
    assert seen == ["before", "after"] * 4
    assert torch.equal(ours[0], doubled[0])


def test_hooks_of_all_optimizers_and_the_profiler_see_every_step_once() -> None:
    seen = []
    handles = [
        register_optimizer_step_pre_hook(lambda *_: seen.append("before")),
        register_optimizer_step_post_hook(lambda *_: seen.append("after")),
    ]
    try:
        train(Adam([parameter((30,))]), gradients((30,), 7, 3))
    finally:
        for handle in handles:
            handle.remove()
    assert seen == ["before", "after"] * 3
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        train(Adam([parameter((30,))]), gradients((30,), 7, 3))
    assert [event.count for event in profile.key_averages() if event.key == "Optimizer.step#Adam.step"] == [3]


def test_hooks_are_called_and_may_change_arguments_as_torchs() -> None:
    def watched(make: type[torch.optim.Adam]) -> list[Any]:
        param = parameter((6,))
        param.grad = torch.ones(6)
        optimizer, seen = make([param], lr=0.1), []

        def other(_: Any, args: Any, kwargs: Any) -> Any:
            seen.append((len(args), sorted(kwargs)))
            return (*args[:1], lambda: 7.0), kwargs

        optimizer.register_step_pre_hook(other)
        optimizer.register_step_post_hook(lambda _, args, kwargs: seen.append((len(args), sorted(kwargs))))
        seen += [optimizer.step(), optimizer.step(lambda: 5.0)]
        return seen

    assert watched(Adam) == watched(torch.optim.Adam) == [(1, []), (2, []), (2, []), (2, []), 7.0, 7.0]


def test_a_closure_is_called_with_gradients_on() -> None:
    param = parameter((6,))
    optimizer = Adam([param])

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = param.square().sum()
        loss.backward()
        return loss

    before = float(param.square().sum().detach())
    assert float(optimizer.step(closure).detach()) == pytest.approx(before)
    assert float(param.square().sum().detach()) < before


def test_a_backward_through_a_changed_parameter_is_refused() -> None:
    param = parameter((6,))
    loss = param.square().sum()
    param.grad = torch.ones(6)
    Adam([param]).step()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_torchs_optimizers_step_by_it_inside_the_block_alone() -> None:
    module = importlib.import_module("torch.optim.adam")
    before = module.adam
    grads = gradients((40_000,), 8, 6)
    # The optimizer is made outside the block, and is of a subclass.
    optimizer = type("Own", (torch.optim.Adam,), {})([parameter((40_000,))], lr=0.01)
    with instead_of_torchs_adam():
        replaced = train(optimizer, grads)
    assert module.adam is before
    ours = train(Adam([parameter((40_000,))], lr=0.01), grads)
    torchs = train(torch.optim.Adam([parameter((40_000,))], lr=0.01, foreach=False), grads)
    assert all(torch.equal(a, b) for a, b in zip(replaced, ours, strict=True))
    torch.testing.assert_close(replaced[0], torchs[0], rtol=1e-6, atol=1e-6)


def test_decoupled_weight_decay_is_torchs_own_inside_the_block() -> None:
    grads = gradients((50, 3), 9, 5)
    theirs = train(torch.optim.AdamW([parameter((50, 3))], weight_decay=0.3), grads)
    with instead_of_torchs_adam():
        ours = train(torch.optim.AdamW([parameter((50, 3))], weight_decay=0.3), grads)
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_the_block_ends_with_an_error_too() -> None:
    module = importlib.import_module("torch.optim.adam")
    before = module.adam
    with pytest.raises(ZeroDivisionError), instead_of_torchs_adam():
        assert module.adam is not before
        _ = 1 / 0
    assert module.adam is before


def test_it_leaves_torchs_compiler_alone() -> None:
    code = (
        "import sys, torch\n"
        "from skipgs_plug.fallback_raster.training.optimizer import Adam\n"
        "param = torch.nn.Parameter(torch.ones(3))\n"
        "optimizer = Adam([param])\n"
        "param.grad = torch.ones(3)\n"
        "optimizer.step(), optimizer.zero_grad()\n"
        "sys.exit('torch._dynamo' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("eps", [1e-15, 0.0])
def test_numbers_that_never_had_a_gradient_are_torchs(eps: float) -> None:
    """They do not change, not even negative zeros. Without `eps` all become NaN, 0 / 0.

    Other numbers may differ in the last bit, because torch rounds differently on ARM.
    """
    generator = torch.Generator().manual_seed(4)
    values = torch.randn(200, 16, generator=generator)
    values[::3] = -0.0
    trained = torch.rand(200, generator=generator) < 0.3
    found = []
    for optimizer in (Adam, torch.optim.Adam):
        param = torch.nn.Parameter(values.clone())
        options = {} if optimizer is Adam else {"fused": True}
        adam = optimizer([param], lr=0.01, eps=eps, **options)
        for _ in range(3):
            param.grad = torch.zeros_like(param)
            param.grad[trained] = torch.randn(int(trained.sum()), 16, generator=generator.manual_seed(5))
            adam.step()
        found.append(param.detach())
    ours, torchs = found
    assert torch.equal(ours.isnan(), torchs.isnan())
    torch.testing.assert_close(ours, torchs, rtol=1e-6, atol=1e-7, equal_nan=True)
    untrained = ours[~trained]
    bits = [one[~trained].nan_to_num().view(torch.int32) for one in (ours, torchs)]
    assert torch.equal(*bits)
    assert untrained.isnan().all() if eps == 0 else torch.equal(untrained, values[~trained])
