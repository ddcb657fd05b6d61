"""Warnings of the gate, which end neither a training nor the gate."""

from __future__ import annotations

import sys
import warnings


def caution(sentence: str, stacklevel: int = 2) -> None:
    """Warn, also where warnings are errors (`python -W error`): there the sentence is printed.

    A warning that is raised inside a training would end it, or let the gate go.

    Args:
        sentence: To be said.
        stacklevel: As in `warnings.warn`, counted from the caller.
    """
    try:
        warnings.warn(sentence, RuntimeWarning, stacklevel=stacklevel + 1)
    except RuntimeWarning:
        _print(sentence)


def _print(sentence: str) -> None:
    print(f"skipgs-plug: {sentence}", file=sys.stderr)
