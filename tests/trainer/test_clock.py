"""What counts as time of training."""

import time

import torch

from skipgs_plug.trainer.clock import TrainClock


def worked_and_slept(processor: bool) -> TrainClock:
    clock = TrainClock(torch.device("cpu"), processor)
    clock.start()
    end = time.process_time() + 0.05
    while time.process_time() < end:
        pass
    clock.mark("forward")
    time.sleep(0.3)
    clock.mark("loss")
    clock.stop(after_densification=True)
    return clock


def test_the_wall_clock_counts_waiting() -> None:
    clock = worked_and_slept(processor=False)
    assert clock.phase_seconds["loss"] >= 0.3
    assert clock.t_total == clock.t_post >= 0.35


def test_processor_time_does_not() -> None:
    clock = worked_and_slept(processor=True)
    assert clock.phase_seconds["forward"] >= 0.05
    assert clock.phase_seconds["loss"] < 0.15
    assert clock.t_total == clock.t_post < 0.25
