"""Messages to the user on stderr. They never end a program."""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterator
from typing import Any


def show(text: str) -> None:
    """Print a text to stderr, if stderr can be written: its disk may be full, or its reader gone."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr)


def say(sentence: str) -> None:
    """Print a sentence to stderr, with the name of the program before it; see `show`."""
    show(f"skipgs-plug: {sentence}")


@contextlib.contextmanager
def plain_warnings(named: str) -> Iterator[None]:
    """Print warnings of one class as `say` prints sentences, inside the `with` statement.

    Args:
        named: Name of the class, so that its module need not be loaded.
    """
    others = warnings.formatwarning

    def formatted(message: Any, category: type[Warning], *place: Any, **line: Any) -> str:
        if category.__name__ == named:
            return f"skipgs-plug: {message}\n"
        return others(message, category, *place, **line)

    warnings.formatwarning = formatted
    try:
        yield
    finally:
        warnings.formatwarning = others
