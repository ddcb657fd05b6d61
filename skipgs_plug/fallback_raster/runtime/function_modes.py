"""Functions that call torch directly, although a `TorchFunctionMode` of their caller is active."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


def without_function_modes(function: Callable[P, R]) -> Callable[P, R]:
    """Let no function mode see the calls of torch that a function makes.

    A mode takes about 2 us per call, and an iteration on the CPU makes 900 calls. `run --cpu` has a mode on, and
    `torch.set_default_device` is one.
    """

    @functools.wraps(function)
    def direct(*args: P.args, **kwargs: P.kwargs) -> R:
        with torch._C.DisableTorchFunction():
            return function(*args, **kwargs)

    return direct
