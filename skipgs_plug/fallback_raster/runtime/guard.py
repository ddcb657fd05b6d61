"""Debug modes that check that kernels stay inside their buffers: `SKIPGS_PLUG_GUARD=1`.

Kernels receive bare addresses. In this mode every call first compares the size of each tensor with the size that the
stub declares. It then runs twice on copies that lie between guard zones, filled with a different pattern each time. A
kernel that writes beyond a buffer changes a zone. A kernel that reads beyond a buffer and uses the value gives two
different results. Calls take several times as long.
"""

import ast
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import CodeType, SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from . import constants
from .constants import blocks
from .parameters import Field

OFF, SIZES, ZONES = range(3)

_level = ZONES if os.environ.get("SKIPGS_PLUG_GUARD", "0") not in ("", "0") else OFF

# Two patterns of four bytes: NaN as a float, and negative, hence no valid index, as an int.
_PATTERNS = (-1, -0x00400002)
# Words of four bytes in the guard zone before and behind each buffer: 4 KiB. Kernels process 16 rows at a time, which
# are at most 3 KiB, so a kernel that is one step off hits the zone.
_ZONE_INTS = 1024


def level() -> int:
    """The current mode: OFF, SIZES, or ZONES, which includes SIZES."""
    return _level


@contextmanager
def at_least(wanted: int) -> Iterator[None]:
    """Turn checks on up to this mode inside the `with` statement. A higher mode of the environment stays on."""
    global _level
    before = _level
    _level = max(_level, wanted)
    try:
        yield
    finally:
        _level = before


class Sizes:
    """Sizes of a kernel's tensors, as its stub declares them.

    A shape is a list of expressions. They may use the kernel's numbers and tensors, its constants and `blocks`:
    `block_start[-1]` is the last element of a tensor. In a struct, its own fields come first. Any other name stands for
    one size, which the first tensor that has the name decides. Such a name holds throughout its struct, and other
    parameters refer to it as `struct.name`.
    """

    def __init__(self, kernel: str, fields: Sequence[Field], own_constants: dict[str, int | float]):
        self._kernel = kernel
        self._constants = {"blocks": blocks, **vars(constants), **own_constants}
        self._parsed: list[tuple[Field, list[tuple[str | None, CodeType]]]] = []
        for field in fields:
            if field.shape is None:
                continue
            expressions = ast.parse(f"({field.shape},)", mode="eval").body
            assert isinstance(expressions, ast.Tuple)
            dimensions = [
                (e.id if isinstance(e, ast.Name) else None, compile(ast.Expression(e), field.shape, "eval"))
                for e in expressions.elts
            ]
            self._parsed.append((field, dimensions))

    def check(self, arguments: dict[str, Any]) -> None:
        """Compare the tensors of a call with their declared sizes.

        Args:
            arguments: Fields by path.

        Raises:
            ValueError: The size of a tensor differs from its declaration.
        """
        shared: dict[str, Any] = dict(self._constants)
        for path, value in arguments.items():
            struct, _, name = path.rpartition(".")
            own = vars(shared.setdefault(struct, SimpleNamespace())) if struct else shared
            own[name] = value
        for field, dimensions in self._parsed:
            struct, _, name = field.path.rpartition(".")
            own = vars(shared[struct]) if struct else shared
            size = arguments[field.path].numel()
            unknown = {name for name, _ in dimensions if name is not None and name not in own and name not in shared}
            known = math.prod(int(eval(code, shared, own)) for name, code in dimensions if name not in unknown)
            if len(unknown) == 1 and known and size % known == 0:
                own[unknown.pop()] = size // known
            elif unknown or size != known:
                raise ValueError(
                    f"{self._kernel}: {field.path} holds {size} numbers, but [{field.shape}] makes {known}."
                )


def run_between_zones(kernel: str, arguments: dict[str, Any], run: Callable[[tuple[Any, ...]], None]) -> None:
    """Run a kernel twice on copies of its tensors that lie between guard zones, and copy the results back.

    Raises:
        AssertionError: The kernel wrote into a zone, or its result depends on the content of a zone.
    """
    results = []
    for pattern in _PATTERNS:
        # Arguments that share memory stay one tensor.
        buffers: dict[tuple[int, int], Tensor] = {}
        inside = []
        for value in arguments.values():
            if isinstance(value, Tensor):
                key = value.data_ptr(), value.numel()
                if key not in buffers:
                    buffers[key] = _surrounded(value, pattern)
                value = _middle(buffers[key], value)
            inside.append(value)
        run(tuple(inside))
        for name, value in arguments.items():
            if isinstance(value, Tensor):
                _check_zones(kernel, name, buffers[value.data_ptr(), value.numel()], pattern)
        results.append(inside)
    for name, value, first, second in zip(arguments, arguments.values(), *results, strict=True):
        if isinstance(value, Tensor):
            if not torch.equal(first.view(torch.uint8), second.view(torch.uint8)):
                raise AssertionError(f"{kernel}: {name} depends on memory outside of the buffers.")
            value.data.copy_(first)  # without a new version for torch: kernels do not count one either


def poison(fresh: Tensor) -> Tensor:
    """In mode ZONES, fill a new tensor with a pattern that shows up if it is read before it is written."""
    if _level == ZONES:
        fresh.view(torch.int32).fill_(_PATTERNS[0])
    return fresh


def _surrounded(value: Tensor, pattern: int) -> Tensor:
    words = -(-value.numel() * value.element_size() // 4)
    buffer = torch.full((words + 2 * _ZONE_INTS,), pattern, dtype=torch.int32, device="cpu")
    _middle(buffer, value).copy_(value.detach())
    return buffer


def _middle(buffer: Tensor, like: Tensor) -> Tensor:
    return buffer[_ZONE_INTS : len(buffer) - _ZONE_INTS].view(like.dtype)[: like.numel()].view(like.shape)


def _check_zones(kernel: str, name: str, buffer: Tensor, pattern: int) -> None:
    for side, zone in (("before", buffer[:_ZONE_INTS]), ("behind", buffer[len(buffer) - _ZONE_INTS :])):
        changed = int((zone != pattern).sum())
        if changed:
            raise AssertionError(f"{kernel} wrote {4 * changed} bytes {side} {name}.")
