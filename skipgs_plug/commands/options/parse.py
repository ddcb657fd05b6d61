"""Command lines to dataclasses.

tyro compares the default of every option with its type. For `int | None` (before Python 3.14) and `tuple[int, ...]` it
uses typeguard, which loads unittest and asyncio and takes 0.1 s of each command. It does not need typeguard for
`Optional[int]` and for the types of several values in this module.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

T = TypeVar("T")


def parse_as(kind: type[T], argv: list[str], command: str) -> T:
    """Return the options of `skipgs-plug COMMAND`. On `--help` or a mistake, tyro prints text and exits."""
    return tyro.cli(kind, args=argv, prog=f"skipgs-plug {command}", config=(tyro.conf.FlagCreatePairsOff,))


def shown(kind: str, default: str) -> Any:
    """Return tyro's annotation for the type and default that --help shows for an optional setting."""
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
