"""Command lines to dataclasses.

tyro compares the default of every option with its type. For `int | None` (before Python 3.14) and `tuple[int, ...]` it
asks typeguard, which loads unittest and asyncio: 0.1 s of each command. It compares `Optional[int]` by itself, and the
types of several values below.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

T = TypeVar("T")


def parse_as(kind: type[T], argv: list[str], command: str) -> T:
    """Return the options of `skipgs-plug COMMAND`; print help or the mistake, and exit, as tyro does."""
    return tyro.cli(kind, args=argv, prog=f"skipgs-plug {command}", config=(tyro.conf.FlagCreatePairsOff,))


def shown(kind: str, default: str) -> Any:
    """Return how --help shows an optional setting and its default."""
    return tyro.conf.arg(metavar=kind, help_behavior_hint=f"(default: {default})")


def several(convert: Callable[[str], Any], metavar: str) -> Any:
    """Return the type of an option that takes any number of values."""

    def read(words: list[str]) -> tuple[Any, ...]:
        return tuple(convert(word) for word in words)

    def write(values: tuple[Any, ...] | None) -> list[str]:
        return ["None"] if values is None else [str(value) for value in values]

    # tyro narrows `tuple` to the type of the default, and then needs typeguard again.
    return Annotated[object, PrimitiveConstructorSpec("*", metavar, read, lambda value: True, write)]


if TYPE_CHECKING:
    Integers = tuple[int, ...]
    Words = tuple[str, ...]
    OptionalIntegers = Integers | None
    OptionalWords = Words | None
else:
    Integers = OptionalIntegers = several(int, "INT ...")
    Words = OptionalWords = several(str, "STR ...")
