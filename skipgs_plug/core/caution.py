"""Warnings of the gate that end neither the training nor the gate."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from skipgs_plug.messages import say


class GateWarning(RuntimeWarning):
    """A warning of the gate. The command line prints its sentence alone, without file, line and source."""


def caution(sentence: str, stacklevel: int = 2) -> None:
    """Issue a GateWarning. If warnings are errors (`python -W error`), print the sentence instead.

    A warning that is raised as an error would end the training, or release the gate.

    Args:
        sentence: Text of the warning.
        stacklevel: Stack level of `warnings.warn`, counted from the caller of this function.
    """
    try:
        warnings.warn(sentence, GateWarning, stacklevel=stacklevel + 1)
    except GateWarning:
        say(sentence)


@contextmanager
def cautioned(what: str) -> Iterator[None]:
    """A block after training, or at a release, whose error becomes a warning: the code after it must run.

    Args:
        what: What the block does; the sentence begins with it.
    """
    try:
        yield
    except Exception as error:
        caution(f"{what} failed ({type(error).__name__}: {error}).", stacklevel=4)
