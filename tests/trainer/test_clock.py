"""Times that count as training."""

import math
import time
from itertools import count

import pytest
import torch

from skipgs_plug.trainer.clock import TrainClock


def worked_and_slept(processor: bool) -> TrainClock:
    clock = TrainClock(torch.device("cpu"), by_processor=processor)
    clock.start()
    end = time.process_time() + 0.05
    while time.process_time() < end:
        pass
    clock.mark("forward")
    time.sleep(0.3)
    clock.mark("loss")
    clock.stop(after_densification=True)
    return clock


def test_both_clocks_run_whichever_is_chosen() -> None:
    for by_processor in (False, True):
        clock = worked_and_slept(by_processor)
        seconds = clock.seconds()
        assert seconds["t_total"] >= 0.35 > 0.25 > seconds["t_total_processor"] >= 0.05
        assert (seconds["t_post"], seconds["t_post_processor"]) == (seconds["t_total"], seconds["t_total_processor"])
        restored = TrainClock(torch.device("cpu"), by_processor)
        restored.load_state_dict(clock.state_dict())
        assert restored.state_dict() == clock.state_dict()


def test_a_state_without_processor_seconds_leaves_them_unknown() -> None:
    state = worked_and_slept(processor=False).state_dict()
    del state["t_total_processor"], state["t_post_processor"]
    assert TrainClock.can_load(state) and not TrainClock.can_load({"t_total": 1.0})
    clock = TrainClock(torch.device("cpu"))
    clock.load_state_dict(state)
    assert clock.t_total == state["t_total"] and math.isnan(clock.processor.total)


def test_the_wall_clock_counts_waiting() -> None:
    clock = worked_and_slept(processor=False)
    assert clock.phase_seconds["loss"] >= 0.3
    assert clock.t_total == clock.t_post >= 0.35


def test_processor_time_does_not() -> None:
    clock = worked_and_slept(processor=True)
    assert clock.phase_seconds["forward"] >= 0.05
    assert clock.phase_seconds["loss"] < 0.15
    assert clock.t_total == clock.t_post < 0.25


@pytest.mark.parametrize(("by_processor", "asked"), [(False, 2), (True, 4)])
def test_the_clock_of_the_processor_is_asked_where_an_iteration_begins_and_ends(
    by_processor: bool, asked: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    processor, wall = count(), count(0, 10)
    clock = TrainClock(torch.device("cpu"), by_processor=by_processor)
    with monkeypatch.context() as patch:
        patch.setattr("time.process_time", lambda: float(next(processor)))
        patch.setattr("time.perf_counter", lambda: float(next(wall)))
        clock.start()
        clock.mark("forward")
        clock.mark("loss")
        clock.stop(after_densification=False)
    assert next(processor) == asked
    assert sum(clock.phase_seconds.values()) == clock.t_total
