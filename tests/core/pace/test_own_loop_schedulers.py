"""PyTorch's schedulers in loops of one's own: they are where they would be if all iterations ran."""

import threading

import pytest
import torch
from torch.optim.lr_scheduler import ExponentialLR, LambdaLR, LRScheduler, OneCycleLR

from skipgs_plug import SkipGate


def final_rate(settings, make, step):
    value = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.SGD([value], lr=0.1)
    scheduler, before = make(optimizer), -1
    with SkipGate(start_iter=40, **settings) as gate:
        for number in gate.iterations(range(100), events=range(10, 40, 10)):
            if gate.backward(value.sum(), view="a", step=number):
                optimizer.step()
            step(scheduler, number, before)
            before = number
            # A scheduler that an iteration creates starts to count there.
            inner = torch.optim.SGD([torch.zeros(1)], lr=1.0)
            inner_scheduler = ExponentialLR(inner, 0.5)
            inner.step()
            inner_scheduler.step()
            assert inner_scheduler.get_last_lr() == [0.5]
    scheduler.step()  # after the loop each call is one step
    return optimizer.param_groups[0]["lr"]


def by_calls(scheduler, number, before):
    for _ in range(before, number):
        scheduler.step()


def to_epoch(scheduler, number, before):
    scheduler.last_epoch = number
    scheduler.step()


def twice(scheduler, number, before):
    scheduler.step()
    scheduler.step()


def each(scheduler, number, before):
    scheduler.step()


@pytest.mark.parametrize("settings", [{"share": 0.3}, {"refine_share": 0.3}])
@pytest.mark.parametrize("step", [each, twice, by_calls, to_epoch])
@pytest.mark.parametrize(
    "make",
    [lambda optimizer: LambdaLR(optimizer, lambda n: 0.99**n), lambda optimizer: OneCycleLR(optimizer, 1.0, 300)],
)
def test_schedulers_are_where_they_would_be_if_all_iterations_ran(settings, step, make):
    original = LRScheduler.step
    assert final_rate(settings, make, step) == pytest.approx(final_rate({"enabled": False}, make, step))
    assert LRScheduler.step is original


@pytest.mark.parametrize("calls", [1, 2])
def test_schedulers_step_for_left_out_iterations_where_a_library_counts_those_that_run(calls):
    """Such a library accumulates gradients over four iterations, and steps in every fourth that runs."""
    value = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.SGD([value], lr=0.1)
    scheduler, runs, seen = ExponentialLR(optimizer, 0.99), 0, {}

    def may_step():
        nonlocal runs
        runs += 1
        if runs % 4 == 0:
            optimizer.step()
            [scheduler.step() for _ in range(calls)]

    said = pytest.warns(RuntimeWarning, match=r"runs % 4 == 0\) counts the iterations that run")  # not of a library
    with said, SkipGate(start_iter=150, share=0.3) as gate:
        for number in gate.iterations(range(200), events=range(20, 150, 20), always=range(4)):
            gate.backward(value.sum(), view="a", step=number)
            may_step()
            if runs % 4 == 0:
                seen[number] = scheduler.last_epoch
    assert len(seen) < 25 and max(seen) > 140
    assert all(abs(epoch - calls * (number + 1) / 4) < 1 for number, epoch in seen.items())


def test_schedulers_step_once_in_each_iteration_after_the_gate_is_released():
    optimizer = torch.optim.SGD([value := torch.nn.Parameter(torch.zeros(2))], lr=0.1)
    scheduler, gate = ExponentialLR(optimizer, 0.99), SkipGate(start_iter=40, share=0.3)
    for number in gate.iterations(range(100), events=range(10, 40, 10)):
        if number > scheduler.last_epoch:  # iterations were left out
            gate.detach()
        gate.backward(value.sum(), view="a", step=number)
        optimizer.step()
        scheduler.step()
    assert scheduler.last_epoch == 100


def test_schedulers_of_two_loops_at_a_time_are_kept_apart():
    gates = [SkipGate(start_iter=40, refine_share=share) for share in (0.3, 0.7)]
    seen = []

    def train(gate):
        optimizer = torch.optim.SGD([torch.zeros(1)], lr=0.1)
        scheduler = ExponentialLR(optimizer, 0.99)
        for step in gate.iterations(range(100), always=()):
            gate.backward(torch.ones((), requires_grad=True), view="a", step=step)
            optimizer.step()
            scheduler.step()
        seen.append(scheduler.last_epoch)

    threads = [threading.Thread(target=train, args=(gate,)) for gate in gates]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert seen == [100, 100]
