"""The verbs: order, batches, signals, tables, state."""

from __future__ import annotations

import io
import json
import re

import numpy as np
import pytest
import torch

from skipgs_plug import GateOrderError, SkipConfig, SkipGate, SkipGSError
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.policy import Policy


def loss_of(value: float) -> torch.Tensor:
    return torch.tensor(value, requires_grad=True)


class Scripted(Policy):
    """A policy that answers from a list."""

    def __init__(self, *skips: bool) -> None:
        self.skips = list(skips)
        self.events: list[tuple[int, int]] = []

    def decide(self, view, loss, step) -> Decision:
        return Decision(self.skips.pop(0), "scripted")

    def notify_event(self, step, n_views) -> None:
        self.events.append((step, n_views))

    def state_dict(self) -> dict:
        return {"skips": list(self.skips)}

    def load_state_dict(self, state) -> None:
        self.skips = list(state["skips"])


def test_backward_says_whether_gradients_were_computed() -> None:
    gate = SkipGate(policy=Scripted(False, True))
    kept, left = loss_of(1.0), loss_of(1.0)
    assert gate.backward(kept, view="a", step=0)
    assert not gate.skipped
    assert not gate.backward(left, view="a", step=1)
    assert gate.skipped
    assert kept.grad is not None
    assert left.grad is None


def test_before_start_the_loss_is_not_even_read() -> None:
    class Unreadable:
        ran = False

        def backward(self) -> None:
            self.ran = True

    gate = SkipGate(start_iter=10)
    loss = Unreadable()
    assert gate.backward(loss, view="a", step=9)
    assert loss.ran
    assert gate.stats()["iterations"] == 1
    assert gate.stats()["gated_iterations"] == 0


@pytest.mark.parametrize(
    ("calls", "message"),
    [
        (lambda g, o: g.step(o), r"step\(\) was called before backward"),
        (lambda g, o: g.update(), r"update\(\) was called before backward"),
        (lambda g, o: (g.backward(loss_of(1.0), "a", 0), g.backward(loss_of(1.0), "a", 0)), "twice for view 'a'"),
        (lambda g, o: (g.backward(loss_of(1.0), "a", 0), g.step(o), g.step(o)), r"step\(\) was called twice"),
        (lambda g, o: (g.backward(loss_of(1.0), "a", 0), g.update(), g.update()), r"update\(\) was called before"),
        (lambda g, o: (g.backward(loss_of(1.0), "a", 0), g.update(), g.step(o)), r"step\(\) was called before"),
        (
            lambda g, o: (g.backward(loss_of(1.0), "a", 0), g.step(o), g.backward(loss_of(1.0), "b", 0)),
            r"after step\(\)",
        ),
        (
            lambda g, o: (g.backward(loss_of(1.0), "a", 0), g.update(), g.backward(loss_of(1.0), "b", 0)),
            r"after update\(\)",
        ),
        (lambda g, o: (g.backward(loss_of(1.0), "a", 5), g.backward(loss_of(1.0), "a", 4)), "went back from 5 to 4"),
        (lambda g, o: g.notify_event("prune"), "before the first iteration"),
    ],
)
def test_verbs_out_of_order_are_named(calls, message: str) -> None:
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
    with pytest.raises(GateOrderError, match=message):
        calls(SkipGate(start_iter=0), optimizer)


def test_verbs_out_of_order_release_the_gate_of_a_run_under_way(recwarn) -> None:
    def twice(gate, step) -> None:
        gate.backward(loss_of(1.0), "a", step)

    def step_twice(gate, step) -> None:
        gate.step(optimizer)
        gate.step(optimizer)

    def back(gate, step) -> None:
        gate.backward(loss_of(1.0), "a", step - 10)

    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))])
    faults = {"twice for view 'a'": twice, r"step\(\) was called twice": step_twice, "went back from 20 to 10": back}
    for message, fault in faults.items():
        gate = SkipGate(start_iter=0, warmup=0, min_bwd_ratio=0.0)
        for step in range(40):
            ran = gate.backward(loss_of(1.0), "a", step)
            assert ran or step <= 20
            if step == 20:
                fault(gate, step)
        assert re.search(f"in iteration [12]0, and training goes on .*{message}", gate.released)
        assert str(recwarn.pop(RuntimeWarning).message) == gate.released and not recwarn


def test_a_batch_may_hold_a_view_twice() -> None:
    gate = SkipGate(policy=Scripted(False, True, False))
    losses = [loss_of(1.0), loss_of(2.0), loss_of(3.0)]
    assert gate.backward(losses, view=["a", "a", "b"], step=0)
    assert [loss.grad is not None for loss in losses] == [True, False, True]
    assert [(row["view"], row["visits"], row["skips"]) for row in gate.view_table()] == [("a", 2, 1), ("b", 1, 0)]


def test_views_of_a_batch_are_gated_one_by_one() -> None:
    gate = SkipGate(policy=Scripted(False, True, False, True, True))
    losses = [loss_of(1.0), loss_of(2.0), loss_of(3.0)]
    assert gate.backward(losses, view=["a", "b", "c"], step=0)
    assert [loss.grad is not None for loss in losses] == [True, False, True]
    assert not gate.skipped
    assert not gate.backward([loss_of(1.0), loss_of(1.0)], view=["a", "b"], step=1)
    assert gate.skipped
    assert [(row["view"], row["visits"], row["skips"]) for row in gate.view_table()] == [
        ("a", 2, 1),
        ("b", 2, 2),
        ("c", 1, 0),
    ]


def test_separate_backwards_of_one_iteration_are_gated_one_by_one() -> None:
    gate = SkipGate(policy=Scripted(False, True))
    assert gate.backward(loss_of(1.0), view="a", step=0)
    assert not gate.backward(loss_of(1.0), view="b", step=0)
    assert not gate.skipped


def test_the_backward_of_a_batch_is_on_the_clock() -> None:
    gate = SkipGate(start_iter=0)
    loss = torch.ones((), requires_grad=True)
    gate.backward([loss * 1.0, loss * 2.0], view=["a", "b"], step=0)
    assert gate.stats()["t_post"] > 0.0


def test_batch_of_another_length_is_refused() -> None:
    with pytest.raises(SkipGSError, match="2 view keys came with 1 losses"):
        SkipGate(start_iter=0).backward([loss_of(1.0)], view=["a", "b"], step=0)


def test_signal_is_what_is_decided_on() -> None:
    gate = SkipGate(start_iter=0, warmup=0, record_trace=True)
    gate.backward(loss_of(1000.0), view="a", step=0, signal=1.0)
    assert not gate.backward(loss_of(5000.0), view="a", step=1, signal=torch.tensor(0.5))
    assert [row.loss for row in gate.trace] == [1.0, 0.5]


def test_events_reach_the_policy_with_the_number_of_views() -> None:
    policy = Scripted(False, False)
    gate = SkipGate(policy=policy)
    gate.backward(loss_of(1.0), view="a", step=3)
    gate.backward(loss_of(1.0), view="b", step=4)
    gate.notify_event("prune")
    gate.notify_event("opacity reset", step=6)
    assert policy.events == [(4, 2), (6, 2)]
    assert gate.stats()["events"] == {"prune": 1, "opacity reset": 1}


def test_a_saved_state_holds_plain_values_whatever_the_loop_counts_with() -> None:
    gate = SkipGate(start_iter=0, warmup=0)
    gate.backward(loss_of(1.0), view=np.array(["a.png"])[0], step=np.int64(4))
    gate.notify_event("prune", step=np.int64(4))
    saved = io.BytesIO()
    torch.save(gate.state_dict(), saved)
    saved.seek(0)
    state = torch.load(saved, weights_only=True)  # it refuses all but plain values
    SkipGate(start_iter=0, warmup=0).load_state_dict(json.loads(json.dumps(state)))


def test_optimizer_steps_on_pending_gradients_only() -> None:
    parameter, other = torch.nn.Parameter(torch.ones(2)), torch.nn.Parameter(torch.ones(2))
    first, second = torch.optim.SGD([parameter], lr=1.0), torch.optim.SGD([other], lr=1.0)
    gate = SkipGate(policy=Scripted(False, True, True))
    gate.backward(parameter.sum(), view="a", step=0)
    assert gate.step({"one": first, "two": second})
    assert parameter.tolist() == [0.0, 0.0]
    assert other.tolist() == [1.0, 1.0]
    # The gradient was not zeroed, so it is still pending in the next iteration, which was skipped.
    gate.backward(parameter.sum(), view="a", step=1)
    assert gate.step(first)
    assert parameter.tolist() == [-1.0, -1.0]
    first.zero_grad(set_to_none=True)
    gate.backward(parameter.sum(), view="a", step=2)
    assert not gate.step([first, second])
    assert parameter.tolist() == [-1.0, -1.0]


def test_step_passes_arguments_on() -> None:
    seen = []

    class Sparse(torch.optim.SGD):
        def step(self, visibility, count):  # type: ignore[override]
            seen.append((visibility, count))

    parameter = torch.nn.Parameter(torch.ones(2))
    gate = SkipGate(start_iter=0)
    gate.backward(parameter.sum(), view="a", step=0)
    mask = torch.tensor([True, False])
    assert gate.step(Sparse([parameter], lr=1.0), mask, 2)
    assert seen[0][0] is mask
    assert seen[0][1] == 2


def test_summary_scalars_and_table_agree() -> None:
    gate = SkipGate(policy=Scripted(False, True, True))
    for step in range(3):
        gate.backward(loss_of(0.5), view="a", step=step)
    assert "2 of 3 backwards skipped (66.7 %)" in gate.summary()
    scalars = gate.scalars()
    assert scalars["skipgs/skips"] == 2.0
    assert scalars["skipgs/skipped"] == 1.0
    assert all(isinstance(value, float) for value in scalars.values())
    assert gate.view_table() == [
        {"view": "a", "visits": 3, "backwards": 1, "skips": 2, "mean_loss": None, "last_loss": 0.5}
    ]


def test_trace_must_be_asked_for() -> None:
    with pytest.raises(SkipGSError, match="record_trace"):
        _ = SkipGate(start_iter=0).trace


def test_trace_holds_the_mean_before_the_loss() -> None:
    gate = SkipGate(start_iter=0, warmup=0, record_trace=True)
    gate.backward(loss_of(1.0), view="a", step=0)
    gate.backward(loss_of(3.0), view="a", step=1)
    gate.backward(loss_of(1.0), view="a", step=2)
    assert [(row.reason, row.skip) for row in gate.trace] == [
        ("new view", False),
        ("deviation", False),
        ("deviation", True),
    ]
    assert gate.trace[2].mean == pytest.approx(0.95 + 0.05 * 3.0)


def test_config_object_serves_as_well() -> None:
    gate = SkipGate(config=SkipConfig(start_iter=7, warmup=1))
    assert gate.config.start_iter == 7


def test_clock_separates_the_part_from_start_on() -> None:
    gate = SkipGate(start_iter=2)
    for step in range(4):
        gate.backward(loss_of(1.0), view="a", step=step)
    stats = gate.stats()
    assert 0.0 < stats["t_post"] < stats["t_total"]


def test_the_processors_clock_is_read_every_10_ms_and_counts_all_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    wall, readings = 0.0, 0

    def processor() -> float:
        nonlocal readings
        readings += 1
        return 2.0 * wall  # two threads are running

    monkeypatch.setattr("time.perf_counter", lambda: wall)
    monkeypatch.setattr("time.process_time", processor)
    gate = SkipGate(start_iter=4)
    counts = []
    for step in range(8):
        gate.backward(loss_of(1.0), view="a", step=step)
        counts.append(readings)
        wall += 0.004
    # This holds in the first iteration too, and where the time after `start_iter` begins.
    assert counts == [1, 1, 1, 2, 3, 3, 3, 4]
    stats = gate.stats()
    assert (stats["t_total"], stats["t_post"]) == pytest.approx((0.028, 0.012))
    assert (stats["t_total_processor"], stats["t_post_processor"]) == pytest.approx((0.056, 0.024))


@pytest.mark.parametrize("loss", [1.0, None, "loss"])
def test_a_loss_that_is_no_tensor_is_refused_and_the_iteration_can_be_given_again(loss) -> None:
    gate = SkipGate(start_iter=0)
    with pytest.raises(SkipGSError, match=r"needs the loss itself, a tensor, not (float|NoneType|str)"):
        gate.backward(loss, view="a", step=0)
    assert gate.backward(loss_of(1.0), view="a", step=0)


def test_a_list_of_views_needs_a_list_of_losses() -> None:
    gate = SkipGate(start_iter=0)
    with pytest.raises(SkipGSError, match="1 view keys came with one loss; give one loss per view"):
        gate.backward(loss_of(1.0), view=["a"], step=0)
    with pytest.raises(SkipGSError, match="a tensor, not float"):
        gate.backward([1.0], view=["a"], step=0)
