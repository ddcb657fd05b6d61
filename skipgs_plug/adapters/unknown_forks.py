"""Forks of Inria 3DGS that no adapter knows: what their loop does beyond Inria's."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import torch

from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.core.errors import AdapterMismatchError

NOISE = frozenset({"randn", "randn_like", "normal"})
# What Inria's loops, classic and current, call of their model, and pass to `render` by name.
CALLS = frozenset(
    {
        "add_densification_stats",
        "capture",
        "densify_and_prune",
        "get_opacity",
        "get_xyz",
        "oneupSHdegree",
        "restore",
        "training_setup",
        "update_learning_rate",
    }
)
ARGUMENTS = frozenset({"scaling_modifier", "override_color", "separate_sh", "use_trained_exp"})


def refuse_unknown_forks(code: LoopCode, render: Callable[..., Any], model: type, events: Iterable[str]) -> None:
    """Refuse a loop that changes tensors itself; warn of one that does more than Inria's.

    Args:
        code: The training script.
        render: Its renderer.
        model: Its GaussianModel.
        events: Methods of the model that are known to be structural changes.

    Raises:
        AdapterMismatchError: The loop draws noise, writes into tensors, or has no end of densification.
    """
    who = f"{code.place} is a fork of Inria 3DGS that no adapter knows"
    by_hand = "Gate it by hand with SkipGate(start_iter=...), or write an adapter (CONTRIBUTING.md)."
    if "densify_until_iter" not in code.used:
        raise AdapterMismatchError(f"{who}: its loop never asks for densify_until_iter. {by_hand}")
    writes = sorted(name for name in code.used if name in NOISE or _writes(name))
    if writes:
        raise AdapterMismatchError(
            f"{who}: its loop changes values itself ({', '.join(writes)}), which would go on alone in skipped "
            f"iterations. {by_hand}"
        )
    known = CALLS | set(events)
    calls = sorted(code.used & set(dir(model)) - known)
    arguments = sorted(code.keywords & set(inspect.signature(render).parameters) - ARGUMENTS)
    if calls or arguments:
        strange = [*(f"render({name}=)" for name in arguments), *(f"{name}()" for name in calls)]
        recognised = ", ".join(sorted(code.used & known))
        warnings.warn(
            f"{who}. Recognised: render, backward, {recognised}. Not recognised, and left to go on in skipped "
            f"iterations: {', '.join(strange)}.",
            RuntimeWarning,
            stacklevel=2,
        )


def _writes(name: str) -> bool:
    """Whether this is a method that changes a tensor in place."""
    return name.endswith("_") and not name.startswith("_") and callable(getattr(torch.Tensor, name, None))
