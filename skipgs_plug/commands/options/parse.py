"""Command lines to dataclasses."""

from __future__ import annotations

from typing import Any, TypeVar

import tyro

T = TypeVar("T")


def parse_as(kind: type[T], argv: list[str], command: str) -> T:
    """Return what `skipgs-plug COMMAND` was given; prints help or what is wrong, and exits, as tyro does."""
    return tyro.cli(kind, args=argv, prog=f"skipgs-plug {command}", config=(tyro.conf.FlagCreatePairsOff,))


def shown(kind: str, default: str) -> Any:
    """How --help shows an option that may be left out, and what holds then."""
    return tyro.conf.arg(metavar=kind, help_behavior_hint=f"(default: {default})")
