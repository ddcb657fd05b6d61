"""Mixed precision: the gate decides by the unscaled loss, and a scaler works in iterations without gradients."""

import gc

import pytest
import torch
from always import Always

from skipgs_plug import SkipGate
from skipgs_plug.core import loss_scaler
from skipgs_plug.core.intercept import Patches
from skipgs_plug.core.loss_scaler import unscaled

METHODS = ("scale", "unscale_", "step", "update")


def scaler(**settings):
    return torch.amp.GradScaler("cpu", **{"init_scale": 2.0**16, "growth_interval": 5, **settings})


def loss_of_view(weight, step):
    return (weight - 1 - step % 3).square().mean()


def train(gate, scaled=None, loss_of=loss_of_view, batch=False):
    """Train with `scaler.step` in every iteration; return the weight after each."""
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer, history = torch.optim.SGD([weight], lr=0.02), []
    for step in range(60):
        losses = [loss_of(weight, step + k) for k in range(2 if batch else 1)]
        names = [f"{(step + k) % 3}.png" for k in range(len(losses))]
        loss = losses if batch else losses[0]
        if scaled is None:
            gate.backward(loss, view=names if batch else names[0], step=step)
            gate.step(optimizer)
        else:
            gate.backward(scaled.scale(loss), view=names if batch else names[0], step=step)
            scaled.unscale_(optimizer)
            scaled.step(optimizer)
            scaled.update()
        optimizer.zero_grad(set_to_none=True)
        history.append(weight.item())
    return history


def replaced():
    return [name for name in METHODS if hasattr(getattr(torch.amp.GradScaler, name), "__skipgs_plug__")]


@pytest.mark.parametrize("batch", [False, True])
def test_decisions_do_not_depend_on_a_scale_that_grows(batch):
    settings = {"start_iter": 0, "warmup": 3, "min_bwd_ratio": 0.0, "record_trace": True}
    with SkipGate(**settings) as gate:
        expected = train(gate, batch=batch)
    with SkipGate(**settings) as mixed:
        assert train(mixed, scaler(), batch=batch) == expected
    assert mixed.trace == gate.trace and mixed.stats()["backwards_skipped"] > 0 and mixed.released is None


def test_a_scaled_loss_that_overflows_is_left_to_the_scaler(recwarn):
    def loss_of(weight, step):
        return 8 + (weight - 1).square().mean()

    scales = scaler(init_scale=2.0**127, growth_interval=1000)
    with SkipGate(start_iter=0, warmup=100) as gate:
        train(gate, scales, loss_of)
    assert not recwarn and gate.stats()["non_finite"] == 0 and gate.stats()["backwards_run"] == 60
    assert scales.get_scale() < 2.0**127


def test_an_unscaled_loss_that_is_not_finite_is_seen():
    with SkipGate(start_iter=0) as gate, pytest.warns(RuntimeWarning, match="Loss is inf"):
        train(gate, scaler(), lambda weight, step: weight.square().mean() + (float("inf") if step == 9 else 0))
    assert gate.stats()["non_finite"] == 1


def test_a_scaler_steps_nothing_in_a_loop_of_ones_own_that_skips():
    with SkipGate(start_iter=10, policy=Always()) as gate:
        history = train(gate, scaler())
    assert history[9:] == [history[9]] * 51 and gate.stats()["backwards_skipped"] == 50


@pytest.fixture
def no_other_gate():
    """Gates that other tests keep are not guarded meanwhile."""
    others = list(loss_scaler._guarded)
    loss_scaler._guarded.clear()
    loss_scaler._restore_after_last()
    yield
    for now in others:
        loss_scaler.guard_scalers(Patches(), now)


def test_methods_come_back_with_the_last_gate_that_is_detached_or_dropped(no_other_gate):
    assert replaced() == []
    first, second, off = SkipGate(start_iter=0), SkipGate(start_iter=0), SkipGate(start_iter=0, enabled=False)
    assert len(first.patched) == 4 and off.patched == []
    first.detach()
    assert replaced() == list(METHODS) and first.patched == []
    del second
    gc.collect()
    assert replaced() == []


def test_a_loop_that_unscales_and_steps_by_itself_is_updated():
    weight, scales = torch.nn.Parameter(torch.ones(1)), scaler()
    optimizer = torch.optim.SGD([weight], lr=0.02)
    with SkipGate(start_iter=1, policy=Always()) as gate:
        for step in range(4):
            gate.backward(scales.scale(weight.sum()), view="a.png", step=step)
            scales.unscale_(optimizer)
            optimizer.step()
            scales.update()  # gradients stay, so each iteration unscales them
    assert scales.get_scale() == 2.0**16 and weight.item() < 1


def test_a_scaler_that_is_off_leaves_the_loss_alone():
    loss = torch.ones((), requires_grad=True) * 2
    with SkipGate(start_iter=0):
        assert scaler(enabled=False).scale(loss) is loss and unscaled(loss) is loss
        assert unscaled(scaler().scale(loss)) == 2 and unscaled(3.0) == 3.0
