"""Memory after a skipped iteration, and backwards that do not wait for the loss."""

from __future__ import annotations

import gc
import math
import random
import weakref

import pytest
import torch

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.core import engine
from skipgs_plug.core.decision import AT_OR_BELOW_MEAN, FULL
from skipgs_plug.core.policy import Policy
from skipgs_plug.core.saved_graph import free_graph
from tests.always import Always
from tests.core.toy_trainer import ToyTrainer, attach

N = 20_000


class Allocated:
    """Counts the live numbers that a forward allocates and saves."""

    def __init__(self):
        self.live = self.peak = 0

    def add(self, tensor):
        numbers = tensor.numel()
        self.live += numbers
        self.peak = max(self.peak, self.live)
        weakref.finalize(tensor.untyped_storage(), self._gone, numbers)

    def _gone(self, numbers):
        self.live -= numbers


ALLOCATED = Allocated()


class Stage(torch.autograd.Function):
    """A stage of a rasterizer, with a buffer for its backward."""

    @staticmethod
    def forward(ctx, x):
        buffer = x.detach() * 2.0
        ALLOCATED.add(buffer)
        ctx.save_for_backward(buffer)
        return x.clone()

    @staticmethod
    def backward(ctx, gradient):
        (buffer,) = ctx.saved_tensors
        return gradient + 0.0 * buffer


class Every(Policy):
    """Skips the decisions that its list marks."""

    def __init__(self, skips):
        self.skips = skips

    def decide(self, view, loss, step):
        return AT_OR_BELOW_MEAN if self.skips[step] else FULL

    def notify_event(self, step, n_views): ...

    def state_dict(self):
        return {}

    def load_state_dict(self, state): ...


def peak(skips, update=True):
    """Most numbers alive in a loop that holds its loss and image until the next forward is done."""
    ALLOCATED.__init__()
    value = torch.nn.Parameter(torch.ones(N))
    with SkipGate(policy=Every(skips)) as gate:
        for step in range(len(skips)):
            image = Stage.apply(Stage.apply(Stage.apply(value)))
            loss = (image.exp() * value).mean()
            gate.backward(loss, view="a", step=step)
            if update:
                gate.update()
    del loss, image
    return ALLOCATED.peak


def test_a_skipped_graph_does_not_raise_the_peak():
    assert peak([False] * 4) == 3 * N
    assert peak([False, True, False]) == peak([False, True, True, True, False]) == 3 * N
    # Until the next step, other backward passes may need the graph.
    assert peak([False, True, False], update=False) > 3 * N


@pytest.mark.parametrize("skips", [[False, True, False, True]])
def test_gradients_are_those_without_a_gate(skips):
    value, plain = torch.nn.Parameter(torch.ones(N)), torch.nn.Parameter(torch.ones(N))
    with SkipGate(policy=Every(skips)) as gate:
        for step, skip in enumerate(skips):
            loss = (Stage.apply(value).exp() * value).mean()
            assert gate.backward(loss, view="a", step=step) is not skip
            gate.update()
    for skip in skips:
        if not skip:
            (Stage.apply(plain).exp() * plain).mean().backward()
    assert torch.equal(value.grad, plain.grad)


def test_a_graph_that_is_shared_stays_until_the_iteration_ends():
    value = torch.nn.Parameter(torch.ones(N))

    class First(Every):
        def decide(self, view, loss, step):
            return AT_OR_BELOW_MEAN if view == "a" else FULL

    with SkipGate(policy=First([])) as gate:
        for step in range(3):
            shared = value.exp()
            assert not gate.backward((shared * value).mean(), view="a", step=step)
            assert gate.backward((shared + value).mean(), view="b", step=step)
            gate.update()


def test_a_backward_through_a_freed_graph_is_an_error_with_a_sentence():
    value = torch.nn.Parameter(torch.ones(N))
    with SkipGate(policy=Always()) as gate:
        for step in range(2):
            loss = (value.exp() * value).mean()
            gate.backward(loss, view="a", step=step)
            gate.update()
        with pytest.raises(SkipGSError, match="needs the graph of a loss whose backward pass was skipped"):
            loss.backward()


class ReadsLater(ToyTrainer):
    """Needs the graph of its loss once more after the training backward pass, every fiftieth iteration."""

    def __init__(self, owner, arguments):
        super().__init__()
        self._owner, self._arguments, self.read = owner, arguments, []

    def train(self):
        for step in range(self.steps):
            self.begin(step)
            loss = (self.render(f"v{step % 10}") ** 2).mean()
            args, kwargs = self._arguments if step % 50 == 0 else ((), {})
            self._owner.backward(loss, *args, **kwargs)
            if step % 50 == 0:
                self.read += torch.autograd.grad(loss, self.parameter)
            self.optimizer.step()
            self.optimizer.zero_grad(set_to_none=True)


KEPT = [((), {"retain_graph": True}), ((None, True), {}), ((None, None, True), {}), ((), {"create_graph": True})]


@pytest.mark.parametrize("arguments", KEPT)
@pytest.mark.parametrize("owner", [torch.Tensor, torch.autograd])
@pytest.mark.filterwarnings("ignore:Using backward")  # of PyTorch, about memory of `create_graph`
def test_a_graph_that_the_trainer_keeps_is_not_freed(owner, arguments):
    trainer = ReadsLater(owner, arguments)
    with attach(trainer, policy=Always()) as gate:
        trainer.train()
    assert gate.released is None and gate.stats()["backwards_skipped"] == 79
    assert len(trainer.read) == 2 and trainer.read[1].abs().min() > 0


def alive(forward):
    """Tensors that a forward saves and that its graph alone holds: with the graph whole, and after it is freed."""
    loss, inside = forward()
    references = [weakref.ref(tensor.untyped_storage()) for tensor in inside]
    del inside
    gc.collect()
    before = sum(reference() is not None for reference in references)
    free_graph(loss)
    gc.collect()
    return before, sum(reference() is not None for reference in references)


def test_all_kinds_of_saved_tensors_are_freed():
    value = torch.nn.Parameter(torch.rand(N))

    def inputs_outputs_and_lists():
        first = value.exp()
        second = first.sin()
        index = torch.arange(0, N, 2)
        third = Stage.apply(second)[index]
        return (third * third).sum().sqrt(), [first, second, index, third]

    before, after = alive(inputs_outputs_and_lists)
    assert before >= 3 and after == 0
    assert value.isfinite().all()


def test_what_others_hold_keeps_its_values():
    value = torch.nn.Parameter(torch.rand(N))
    image = value.exp()
    loss = (image * image).mean()
    kept, target = image.detach(), image.detach().clone()
    free_graph(loss)
    free_graph(loss)  # a second call finds no tensors
    assert torch.equal(kept, target) and torch.equal(image, target)


def test_iterations_that_run_pay_nothing():
    """No hook of the gate's is called, or stands anywhere, until a backward is skipped."""
    top = getattr(torch._C._autograd, "_top_saved_tensors_default_hooks", lambda _: None)
    value = torch.nn.Parameter(torch.ones(N))
    gate = SkipGate(policy=Every([False, True, False]))
    for step in range(3):
        assert top(True) is None
        loss = (value.exp() * value).mean()
        assert top(True) is None
        gate.backward(loss, view="a", step=step)
    assert top(True) is None


def test_hooks_of_the_trainers_own_are_left_alone():
    value, packed = torch.nn.Parameter(torch.ones(N)), []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: packed.append(t) or t, lambda t: t):
        loss = value.exp().mean()
    free_graph(loss)
    loss.backward()
    assert packed and value.grad is not None


def losses(gate, steps, poison=()):
    """Train on losses of a random walk; return the parameter's gradient after each iteration."""
    draw, left = random.Random(0), []
    value = torch.nn.Parameter(torch.ones(4))
    for step in range(steps):
        scale = math.nan if step in poison else draw.uniform(0.8, 1.2)
        loss = value.mean() * scale
        answer = gate.backward(loss, view=f"v{step % 7}", step=step)
        left.append((answer, None if value.grad is None else value.grad.isfinite().all().item()))
        value.grad = None
    return left


@pytest.mark.parametrize("settings", [{}, {"min_bwd_ratio": 0.0}, {"min_bwd_ratio": 0.9, "warmup": 10}])
def test_a_backward_that_does_not_wait_is_decided_on_the_same(settings, monkeypatch):
    traces = []
    for device in (False, True):
        monkeypatch.setattr(engine, "copies_in_background", lambda _, device=device: device)
        gate = SkipGate(start_iter=50, record_trace=True, **settings)
        losses(gate, 2000)
        gate.notify_event("prune", 1999)
        traces.append((gate.trace, gate.state_dict()["policy"], gate.state_dict()["stats"]))
    assert traces[0] == traces[1] and any(row.skip for row in traces[0][0])


@pytest.mark.parametrize("mode, left", [("skip", (False, None)), ("pass", (True, False))])
def test_a_loss_that_is_not_finite_is_seen_behind_its_backward_and_before_the_step(mode, left, monkeypatch):
    monkeypatch.setattr(engine, "copies_in_background", lambda _: True)
    gate = SkipGate(start_iter=0, warmup=100, on_nonfinite=mode)
    with pytest.warns(RuntimeWarning, match="Loss is nan in iteration 20"):
        seen = losses(gate, 30, poison=(20,))
    assert seen[20] == left and seen[19] == seen[21] == (True, True)


def test_a_loss_that_stops_training_leaves_no_gradient(monkeypatch):
    monkeypatch.setattr(engine, "copies_in_background", lambda _: True)
    value = torch.nn.Parameter(torch.ones(4))
    gate = SkipGate(start_iter=0, on_nonfinite="raise")
    with pytest.raises(SkipGSError, match="Loss is nan"):
        gate.backward(value.mean() * math.nan, view="a", step=0)
    assert value.grad is None
