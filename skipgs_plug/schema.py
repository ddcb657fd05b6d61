"""Check a value that was read from a file against its type, once, before it is used."""

from __future__ import annotations

import math
import types
from collections.abc import Mapping
from typing import Any, Union, get_args, get_origin, get_type_hints, is_typeddict

NAMES = {int: "a whole number >= 0", float: "a finite number", str: "text", bool: "true or false", type(None): "none"}


class SchemaError(ValueError):
    """An entry is missing or wrong. The message is a clause that names it, without a full stop."""


def check(value: Any, kind: Any, name: str) -> None:
    """Raise SchemaError unless `value` is of type `kind`.

    Args:
        value: Plain values, containers and tensors.
        kind: A TypedDict (unknown entries pass, and entries that it does not require may be missing), `dict[K, V]`,
            `list[T]`, `tuple[A, B, ...]` (a list passes too), a union, `Any`, or a class. `int` is a count (a whole
            number >= 0, no bool), `float` is a finite number. `numbers.Real` allows NaN and infinity.
        name: Name of the value in messages.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Any:
        return
    if is_typeddict(kind):
        _require(isinstance(value, Mapping), value, "a dict", name)
        entries = get_type_hints(kind)
        missing = [key for key in entries if key in kind.__required_keys__ and key not in value]
        if missing:
            raise SchemaError(f"{name} lacks {', '.join(missing)}")
        for key, entry in entries.items():
            if key in value:
                check(value[key], entry, f"{name}.{key}")
    elif origin is dict:
        _require(isinstance(value, Mapping), value, "a dict", name)
        for key, entry in value.items():
            check(key, inner[0], f"a key of {name}")
            check(entry, inner[1], f"{name}.{key}")
    elif origin is list:
        _require(isinstance(value, list), value, "a list", name)
        for i, entry in enumerate(value):
            check(entry, inner[0], f"{name}[{i}]")
    elif origin is tuple:
        fits = isinstance(value, (list, tuple)) and len(value) == len(inner)
        _require(fits, value, f"a list of {len(inner)}", name)
        for i, (entry, one) in enumerate(zip(value, inner, strict=True)):
            check(entry, one, f"{name}[{i}]")
    elif origin in (Union, types.UnionType):
        _require(any(_fits(value, one, name) for one in inner), value, " or ".join(map(_called, inner)), name)
    else:
        _require(_is(value, kind), value, _called(kind), name)


def _is(value: Any, kind: type) -> bool:
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool) and value >= 0
    if kind is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return isinstance(value, kind)


def _fits(value: Any, kind: Any, name: str) -> bool:
    try:
        check(value, kind, name)
    except SchemaError:
        return False
    return True


def _called(kind: Any) -> str:
    return NAMES[kind] if kind in NAMES else str(getattr(kind, "__name__", kind))


def _require(fits: bool, value: Any, expected: str, name: str) -> None:
    if not fits:
        shown = repr(value) if isinstance(value, (int, float, str, bool, type(None))) else type(value).__name__
        raise SchemaError(f"{name} is {shown[:40]}, not {expected}")
