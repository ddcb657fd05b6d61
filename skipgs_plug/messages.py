"""Messages to the user on stderr. They never end a program."""

from __future__ import annotations

import contextlib
import sys


def show(text: str) -> None:
    """Print a text to stderr, if stderr can be written: its disk may be full, or its reader gone."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr)


def say(sentence: str) -> None:
    """Print a sentence to stderr, with the name of the program before it; see `show`."""
    show(f"skipgs-plug: {sentence}")
