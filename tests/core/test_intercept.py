"""Replaced names: called around, listed, put back."""

from __future__ import annotations

import types
from collections.abc import Callable
from typing import Any

import pytest
import torch

from skipgs_plug.core.errors import AdapterMismatchError, SkipGSError
from skipgs_plug.core.intercept import Patches, intercept_tensor_backward


class Base:
    def work(self, x: int) -> int:
        return x + 1


class Child(Base):
    pass


def twice(original, *args):
    return 2 * original(*args)


def owners():
    module = types.ModuleType("some_module")
    module.work = lambda x: x + 1
    return [
        (Base, lambda: Base().work(1)),
        (Child, lambda: Child().work(1)),
        (instance := Child(), lambda: instance.work(1)),
        (module, lambda: module.work(1)),
        (vars(module), lambda: module.work(1)),
    ]


@pytest.mark.parametrize("index", range(5))
def test_wraps_and_restores(index: int) -> None:
    owner, call = owners()[index]
    before = dict(owner) if isinstance(owner, dict) else dict(vars(owner))
    patches = Patches()
    patches.wrap(owner, "work", twice)
    assert call() == 4
    assert len(patches.names) == 1
    assert patches.names[0].endswith(".work")
    patches.restore()
    patches.restore()
    assert call() == 2
    assert patches.names == []
    assert (dict(owner) if isinstance(owner, dict) else dict(vars(owner))) == before


def test_a_method_stays_a_method() -> None:
    """Learning-rate schedulers of PyTorch read optimizer.step.__func__."""
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
    patches = Patches()
    patches.wrap(optimizer, "step", lambda original, *args: original(*args))
    torch.optim.lr_scheduler.ExponentialLR(optimizer, gamma=0.9)
    optimizer.step()
    patches.restore()


def test_a_name_that_somebody_else_removed_keeps_nothing_from_being_put_back() -> None:
    class Player:
        def play(self) -> int:
            return 3

    original, player, patches = Base.work, Player(), Patches()
    patches.wrap(Base, "work", twice)
    patches.wrap(player, "play", twice)
    del player.play  # deletes it from the instance; the class keeps its own
    patches.restore()
    assert patches.names == []
    assert Base.work is original
    assert player.play() == 3


def test_an_undo_that_fails_is_warned_of_and_the_others_follow() -> None:
    original, patches = Base.work, Patches()
    patches.wrap(Base, "work", twice)
    patches.add_undo("the middle", [].pop)
    with pytest.warns(RuntimeWarning, match=r"Putting back the middle failed \(IndexError"):
        patches.restore()
    assert patches.names == [] and Base.work is original


def test_second_gate_is_refused() -> None:
    first, second = Patches(), Patches()
    first.wrap(Base, "work", twice)
    with pytest.raises(SkipGSError, match=r"Base\.work is gated already: detach"):
        second.wrap(Base, "work", twice)
    first.restore()
    second.wrap(Base, "work", twice)
    second.restore()


def test_missing_names_are_named_with_what_was_checked() -> None:
    with pytest.raises(AdapterMismatchError, match=r"Base\.play does not exist\. Checked with 1\.0\."):
        Patches("Checked with 1.0.").wrap(Base, "play", twice)


def training(loss: torch.Tensor) -> None:
    loss.backward()


def score(loss: torch.Tensor) -> None:
    loss.backward()


def test_only_the_training_backward_is_handed_over() -> None:
    patches, seen = Patches(), []
    original = torch.Tensor.backward
    intercept_tensor_backward(patches, ("training",), lambda loss, run, keeps_graph: seen.append(loss.item()))
    try:
        a, b, c = (torch.ones(1, requires_grad=True) for _ in range(3))
        training(a.sum())
        score(b.sum())
        c.sum().backward()
        vector = torch.ones(2, requires_grad=True)
        (vector * 2).backward(torch.ones(2))
    finally:
        patches.restore()
    assert seen == [1.0]
    assert a.grad is None
    assert b.grad is not None
    assert c.grad is not None
    assert vector.grad is not None
    assert torch.Tensor.backward is original


@pytest.mark.parametrize("in_list", [False, True])
def test_backward_of_autograd_is_handed_over_too(in_list: bool) -> None:
    patches, seen, others = Patches(), [], []

    def training(loss: torch.Tensor) -> None:
        torch.autograd.backward([loss] if in_list else loss)

    def score(*losses: torch.Tensor) -> None:
        torch.autograd.backward(losses)

    original = torch.autograd.backward
    a, b, c = (torch.ones(1, requires_grad=True) for _ in range(3))

    def gated(loss: torch.Tensor, run: Callable[[], Any], keeps_graph: bool) -> None:
        assert not keeps_graph
        seen.append(loss.item())
        run()

    intercept_tensor_backward(patches, ("training",), gated, others.append)
    try:
        training(a.sum())
        score(b.sum())
        score(b.sum(), c.sum())
        globals()["score"](c.sum())
    finally:
        patches.restore()
    assert seen == [1.0] and others == ["score", "score"]
    assert [one.grad.item() for one in (a, b, c)] == [1.0, 2.0, 2.0]
    assert torch.autograd.backward is original


class Accelerator:
    """Calls backward as accelerate, Fabric and precision plugins do."""

    def backward(self, loss: torch.Tensor) -> None:
        loss.backward()


def test_a_backward_that_calls_backward_is_not_its_caller() -> None:
    patches, seen = Patches(), []
    intercept_tensor_backward(patches, ("training",), lambda loss, run, keeps_graph: seen.append(loss.item()))

    def training(loss: torch.Tensor) -> None:
        Accelerator().backward(loss)

    def score(loss: torch.Tensor) -> None:
        Accelerator().backward(loss)

    a, b = (torch.ones(1, requires_grad=True) for _ in range(2))
    try:
        training(a.sum())
        score(b.sum())
    finally:
        patches.restore()
    assert seen == [1.0] and a.grad is None and b.grad is not None


def test_the_real_backward_keeps_its_arguments() -> None:
    patches = Patches()
    intercept_tensor_backward(patches, ("training_twice",), lambda loss, run, keeps_graph: run())

    def training_twice(loss: torch.Tensor) -> None:
        loss.backward(retain_graph=True)
        loss.backward()

    with_grad = torch.ones(1, requires_grad=True)
    try:
        training_twice((with_grad**2).sum())
    finally:
        patches.restore()
    assert with_grad.grad is not None
    assert with_grad.grad.item() == 4.0
