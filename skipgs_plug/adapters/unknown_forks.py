"""What a loop of the Inria family does beyond what its adapter knows."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch

from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.core.errors import AdapterMismatchError

NOISE = frozenset({"randn", "randn_like", "normal"})
# Methods of a tensor that change no values.
HARMLESS = frozenset({"requires_grad_", "share_memory_", "detach_", "rename_"})
# What Inria's loops, classic and current, call of their model, and pass to `render` by name.
CALLS = frozenset(
    {
        "add_densification_stats",
        "capture",
        "densify_and_prune",
        "get_opacity",
        "get_rotation",
        "get_scaling",
        "get_xyz",
        "oneupSHdegree",
        "restore",
        "training_setup",
        "update_learning_rate",
    }
)
ARGUMENTS = frozenset({"scaling_modifier", "override_color", "separate_sh", "use_trained_exp"})
BY_HAND = "Gate it by hand with SkipGate(start_iter=...), or write an adapter (CONTRIBUTING.md)."


class Unrecognised(NamedTuple):
    """What a loop does that its adapter does not know.

    Attributes:
        calls: methods of the model.
        arguments: arguments of the renderer.
        noise: functions that draw random numbers.
        writes: methods that change a tensor in place, and `data`, which is assigned to.
        known: what the adapter did recognise.
    """

    calls: frozenset[str]
    arguments: frozenset[str]
    noise: frozenset[str]
    writes: frozenset[str]
    known: frozenset[str]

    def refuse(self, who: str) -> None:
        """Refuse a loop that changes tensors itself.

        Args:
            who: Beginning of the sentence.

        Raises:
            AdapterMismatchError: The loop writes into tensors. Noise alone does not: it may be given to a network.
        """
        if self.writes:
            names = ", ".join(sorted(self.writes | self.noise))
            raise AdapterMismatchError(
                f"{who}: its loop changes values itself ({names}), which would go on alone in skipped iterations. "
                f"{BY_HAND}"
            )

    @property
    def listed(self) -> str:
        """All of it in one line; empty where everything was recognised."""
        return ", ".join(
            [
                *(f"render({name}=)" for name in sorted(self.arguments)),
                *(f"{name}()" for name in sorted(self.calls | self.noise)),
            ]
        )


def unrecognised(
    code: LoopCode,
    renderers: Iterable[Callable[..., object]],
    model: type,
    calls: Iterable[str],
    arguments: Iterable[str],
) -> Unrecognised:
    """Compare a loop, and the functions that it calls, with what its adapter knows.

    Args:
        code: The training script.
        renderers: Its renderers.
        model: Its GaussianModel.
        calls: What the adapter knows beyond Inria's: methods of the model, functions that draw noise, methods that
            change tensors in place.
        arguments: Arguments of the renderers that the adapter knows beyond Inria's.
    """
    known = CALLS | set(calls)
    parameters = {name for one in renderers for name in inspect.signature(one).parameters}
    writes = {name for name in code.repeated if writes_in_place(name)} | ({"data"} & code.stored)
    return Unrecognised(
        frozenset(code.repeated & _methods(model) - known),
        frozenset(code.keywords & parameters - ARGUMENTS - set(arguments)),
        frozenset(code.repeated & NOISE - known),
        frozenset(writes - known),
        frozenset(code.used & known),
    )


def writes_in_place(name: str) -> bool:
    """Whether this is a method that changes the values of a tensor in place."""
    private = name.startswith("_") or not name.endswith("_")
    return not private and name not in HARMLESS and callable(getattr(torch.Tensor, name, None))


def _methods(model: type) -> set[str]:
    return {name for name in dir(model) if not name.startswith("_") and name not in dir(torch.nn.Module)}
