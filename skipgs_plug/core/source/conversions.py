"""Conversions: calls that only make a new value of their arguments, as `numpy.int64(step).item()` does."""

from __future__ import annotations

import ast
import builtins
import inspect
import math
from collections.abc import Callable
from numbers import Number
from typing import Any

import numpy as np
import torch


def is_conversion(call: ast.Call, value: Callable[[ast.expr], Any]) -> bool:
    """Whether a call changes nothing, and only makes a new value of its arguments: a number, a text or an array.

    Methods of such a value, as in `torch.tensor(step).item()`, are conversions too.

    Args:
        call: The call.
        value: Returns the value of the expression before the brackets of a call; None if it is unknown.
    """
    match call.func:
        case ast.Attribute(ast.JoinedStr()):
            return True
        case ast.Attribute(ast.Call() as made) if is_conversion(made, value):
            return True
        case ast.Name(name):
            return _converts(value(call.func) or getattr(builtins, name, None))
    return _converts(value(call.func))


def _converts(function: Any) -> bool:
    if inspect.isclass(function):
        return function.__module__ in ("builtins", "decimal", "fractions", "numpy") and issubclass(
            function, (Number, str)
        )
    if isinstance(function, np.ufunc) or getattr(function, "__module__", None) == math.__name__:
        return True
    return any(function is one for one in (np.array, np.asarray, torch.as_tensor, torch.tensor))
