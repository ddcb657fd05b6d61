"""Command lines to dataclasses.

tyro compares the default of every option with its type. For `int | None` (before Python 3.14) and `tuple[int, ...]` it
uses typeguard, which loads unittest and asyncio and takes 0.1 s of each command. It does not need typeguard for
`Optional[int]` and for the types of several values in this module.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from skipgs_plug.trainer.errors import InputError

T = TypeVar("T")


def parse_as(kind: type[T], argv: list[str], command: str) -> T:
    """Return the options of `skipgs-plug COMMAND`. On `--help` or a mistake, tyro prints text and exits.

    Raises:
        InputError: An argument is empty.
    """
    refuse_empty(argv)
    return tyro.cli(kind, args=argv, prog=f"skipgs-plug {command}", config=(tyro.conf.FlagCreatePairsOff,))


def refuse_empty(argv: Sequence[str]) -> None:
    """Raise InputError for the first empty argument, as a shell variable that is not set leaves it.

    pathlib would take the current folder for it, and an option would be ignored.
    """
    for number, (before, argument) in enumerate(itertools.pairwise(("", *argv)), 1):
        if argument and not (argument.startswith("--") and argument.endswith("=")):
            continue
        option = argument[:-1] or (before if before.startswith("--") and "=" not in before else "")
        raise InputError(
            f"{option} is empty; give it a value, or leave it out."
            if option
            else f"Argument {number} is empty; give the name of a file or folder."
        )


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
