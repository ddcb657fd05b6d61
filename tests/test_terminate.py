"""SIGTERM ends a block like Ctrl-C, whatever it interrupts."""

import signal
import sys
import time

import pytest

from skipgs_plug.terminate import Terminated, terminable


class Dies:
    def __del__(self):
        signal.raise_signal(signal.SIGTERM)
        sum(range(100))  # the handler runs in here, so that Python drops its error


def test_sigterm_inside_a_finalizer_is_not_lost():
    handler, hook = signal.getsignal(signal.SIGTERM), sys.unraisablehook
    with pytest.raises(Terminated), terminable():
        Dies()
        time.sleep(30)
    assert signal.getsignal(signal.SIGTERM) is handler and sys.unraisablehook is hook


def test_other_errors_of_finalizers_are_reported(monkeypatch):
    dropped = []
    monkeypatch.setattr(sys, "unraisablehook", dropped.append)

    class Fails:
        def __del__(self):
            raise ValueError

    with terminable():
        Fails()
    assert [one.exc_type for one in dropped] == [ValueError]
