"""What a training loop uses, read from its code without running it."""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from skipgs_plug.core.errors import AdapterMismatchError

LOOP = "training"  # name of the function that holds the loop, in the whole Inria family


class LoopCode(NamedTuple):
    """The names in a training script.

    Attributes:
        place: file of the script, or name of the module, for sentences.
        names: global names of the script, and every global and attribute that its loop uses.
        used: those of the loop alone, which is its function `training`; none where it has no such function.
        keywords: names by which the loop passes arguments.
    """

    place: str
    names: frozenset[str]
    used: frozenset[str] = frozenset()
    keywords: frozenset[str] = frozenset()

    @classmethod
    def of_module(cls, namespace: Mapping[str, Any]) -> LoopCode:
        """Of a module that was imported."""
        place = str(namespace.get("__file__") or namespace.get("__name__"))
        code = getattr(namespace.get(LOOP), "__code__", None)
        return cls._made(place, set(namespace), code)

    @classmethod
    def of_script(cls, path: Path) -> LoopCode:
        """Of a script that is about to run.

        Raises:
            AdapterMismatchError: It is no Python.
        """
        try:
            script = compile(path.read_bytes(), str(path), "exec")
        except (SyntaxError, ValueError) as error:
            raise AdapterMismatchError(f"{path} is not a Python script: {error}.") from error
        inner = [const for const in script.co_consts if isinstance(const, types.CodeType)]
        code = next((one for one in inner if one.co_name == LOOP), None)
        return cls._made(str(path), {*script.co_names, *(one.co_name for one in inner)}, code)

    @classmethod
    def _made(cls, place: str, own: set[str], code: types.CodeType | None) -> LoopCode:
        if code is None:
            return cls(place, frozenset(own))
        parts = list(_with_inner(code))
        used = frozenset(name for part in parts for name in part.co_names)
        # The names of keywords stand together in one constant.
        keywords = frozenset(
            word
            for part in parts
            for const in part.co_consts
            if isinstance(const, tuple) and const and all(isinstance(word, str) for word in const)
            for word in const
        )
        return cls(place, frozenset(own) | used, used, keywords)


def _with_inner(code: types.CodeType) -> Iterator[types.CodeType]:
    yield code
    for const in code.co_consts:
        if isinstance(const, types.CodeType):
            yield from _with_inner(const)
