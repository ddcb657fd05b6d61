"""Times that count as training."""

import math
from itertools import count

import pytest
import torch

from skipgs_plug.trainer.clock import TrainClock


class FakeTime:
    """The clocks of a process that works and sleeps as a test says. Real ones count other threads, too."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wall, self.processor = 100.0, 10.0
        monkeypatch.setattr("time.perf_counter", lambda: self.wall)
        monkeypatch.setattr("time.process_time", lambda: self.processor)

    def work(self, seconds: float) -> None:
        self.wall += seconds
        self.processor += seconds

    def sleep(self, seconds: float) -> None:
        self.wall += seconds


def worked_and_slept(processor: bool, time: FakeTime) -> TrainClock:
    clock = TrainClock(torch.device("cpu"), by_processor=processor)
    clock.start()
    time.work(0.25)
    clock.mark("forward")
    time.sleep(0.5)
    clock.mark("loss")
    clock.stop(after_densification=True)
    return clock


@pytest.fixture
def fake_time(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    return FakeTime(monkeypatch)


@pytest.mark.parametrize("by_processor", [False, True])
def test_both_clocks_run_whichever_is_chosen(by_processor: bool, fake_time: FakeTime) -> None:
    clock = worked_and_slept(by_processor, fake_time)
    seconds = clock.seconds()
    assert (seconds["t_total"], seconds["t_total_processor"]) == (0.75, 0.25)
    assert (seconds["t_post"], seconds["t_post_processor"]) == (0.75, 0.25)
    restored = TrainClock(torch.device("cpu"), by_processor)
    restored.load_state_dict(clock.state_dict())
    assert restored.state_dict() == clock.state_dict()


def test_a_state_without_processor_seconds_leaves_them_unknown(fake_time: FakeTime) -> None:
    state = worked_and_slept(False, fake_time).state_dict()
    del state["t_total_processor"], state["t_post_processor"]
    assert TrainClock.can_load(state) and not TrainClock.can_load({"t_total": 1.0})
    clock = TrainClock(torch.device("cpu"))
    clock.load_state_dict(state)
    assert clock.t_total == state["t_total"] and math.isnan(clock.processor.total)


def test_the_wall_clock_counts_waiting(fake_time: FakeTime) -> None:
    clock = worked_and_slept(False, fake_time)
    assert clock.phase_seconds["loss"] == 0.5
    assert clock.t_total == clock.t_post == 0.75


def test_processor_time_does_not(fake_time: FakeTime) -> None:
    clock = worked_and_slept(True, fake_time)
    assert (clock.phase_seconds["forward"], clock.phase_seconds["loss"]) == (0.25, 0.0)
    assert clock.t_total == clock.t_post == 0.25


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
