"""Milestones of a loop in a test, as the gate reads them when the loop asks for its numbers."""

import re
import sys

import pytest

from skipgs_plug.core.source.lines import line_of
from skipgs_plug.core.source.reading import read_loop

NUMBERS = range(50, 100)


def found(loop, pure=(), known=None):
    """Milestones of a function; its loop must run over `stop(names)`, which stands where a `LoopRange` is asked."""
    caught = {}

    class Stopped(Exception):
        pass

    def stop(**names):
        code = sys._getframe(1).f_code
        caught.update(read_loop(code, line_of(code), {**loop.__globals__, **names}, pure, known).milestones(NUMBERS))
        raise Stopped

    with pytest.raises(Stopped):
        loop(stop)
    return {re.sub(r"^line \d+: ", "", reason): sorted(numbers) for reason, numbers in caught.items() if numbers}


def numbers(loop):
    """Numbers that the conditions of a loop name, in order."""
    return sorted(set().union(*found(loop).values()))
