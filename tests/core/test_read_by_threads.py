"""Threads of viewers and loggers read the gate while it trains."""

import sys
import threading

import pytest
import torch

from skipgs_plug import SkipGate


@pytest.fixture
def frequent_switches():
    """Threads take turns as often as the interpreter can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.parametrize("name", ["stats", "summary", "scalars", "view_table", "report", "state_dict"])
def test_a_thread_reads_while_views_are_added(name, frequent_switches):
    loss, over, errors = torch.ones((), requires_grad=True), threading.Event(), []
    gate = SkipGate(start_iter=0)
    gate.backward(loss, view="first", step=0)

    def read():
        while not over.is_set():
            try:
                getattr(gate, name)()
            except Exception as error:
                errors.append(error)
                return

    reader = threading.Thread(target=read)
    reader.start()
    for step in range(1, 1_000):
        gate.backward(loss, view=f"{step}.png", step=step)
    over.set()
    reader.join()
    assert not errors and gate.stats()["gated_iterations"] == 1_000
