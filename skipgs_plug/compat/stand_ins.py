"""Replaces names of other packages by stand-ins, for a while."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

MISSING = object()  # marks a name that the owner did not have


@contextmanager
def stand_ins(replaced: Sequence[tuple[Any, str, Any]]) -> Iterator[None]:
    """Replace each (owner, name) by its stand-in inside the `with` statement, and restore all names afterwards."""
    before = [(owner, name, getattr(owner, name, MISSING)) for owner, name, _ in replaced]
    for owner, name, stand_in in replaced:
        setattr(owner, name, stand_in)
    try:
        yield
    finally:
        for owner, name, original in before:
            if original is MISSING:
                delattr(owner, name)
            else:
                setattr(owner, name, original)
