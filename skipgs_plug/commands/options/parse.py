"""Command lines to dataclasses."""

from __future__ import annotations

from typing import Any, TypeVar

import tyro

T = TypeVar("T")


def parse_as(kind: type[T], argv: list[str], command: str) -> T:
    """Return the options of `skipgs-plug COMMAND`; print help or the mistake, and exit, as tyro does."""
    return tyro.cli(kind, args=argv, prog=f"skipgs-plug {command}", config=(tyro.conf.FlagCreatePairsOff,))


def shown(kind: str, default: str) -> Any:
    """Return how --help shows an optional setting and its default."""
    return tyro.conf.arg(metavar=kind, help_behavior_hint=f"(default: {default})")
