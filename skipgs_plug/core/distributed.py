"""Several processes: either all ranks run the backward pass of an iteration or no rank does, else collectives hang."""

from __future__ import annotations

import contextlib
import os
import weakref
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from skipgs_plug.core import decision
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.errors import SkipGSError

# Smallest wins: one rank's error stops all, one poisoned loss is left out by all, one backward makes all run.
_ABORT, _POISONED, _RUN, _SKIP = range(4)


_AVAILABLE = dist.is_available()  # whether this build of PyTorch has torch.distributed


def group_size() -> int:
    """Return the number of processes that train together; 1 without torch.distributed."""
    if _AVAILABLE and dist.is_initialized():
        return dist.get_world_size()
    return 1


def refuse_unreachable_ranks(world_size: int | None = None) -> None:
    """Raise SkipGSError if there are other processes but no process group through which gates can agree."""
    world = int(os.environ.get("WORLD_SIZE") or 1) if world_size is None else world_size
    if world > 1 and group_size() == 1:
        raise SkipGSError(
            f"{world} processes train together, but torch.distributed is not initialised, so their gates "
            "cannot agree; call init_process_group() first, or train in one process."
        )


def refuse_several(because: str, instead: str) -> None:
    """Raise SkipGSError if several processes train together; its sentence is made of `because` and `instead`."""
    if group_size() > 1:
        raise SkipGSError(f"{because}, but {group_size()} train together; {instead}.")


def agree(own: Decision, device: torch.device | None = None) -> Decision:
    """Combine this rank's decision with those of all others: skip only if every rank would.

    Args:
        own: Decision of this rank.
        device: Device of the loss, to which votes go if the group has no CPU backend; None for a plain number.

    Raises:
        SkipGSError: Another rank stopped with an error, or does not answer.
    """
    vote = _SKIP if own.skip else _RUN
    lowest = _lowest(_POISONED if own is decision.NON_FINITE else vote, device)
    if lowest == _ABORT:
        raise SkipGSError("The gate of another process stopped with an error; see its output.")
    if lowest == _POISONED:
        return decision.NON_FINITE
    if lowest == _RUN and own.skip:
        return decision.OTHER_RANK
    return own


def abort(device: torch.device | None = None) -> None:
    """Tell the other ranks that this rank raises an error, so that they do not wait. They may have ended already."""
    with contextlib.suppress(SkipGSError):
        _lowest(_ABORT, device)


def mean(values: Tensor) -> list[float]:
    """Return the mean of each value [K] over all ranks, with one read of the device. All ranks must call it together.

    Raises:
        SkipGSError: Another rank does not answer.
    """
    size = group_size()
    if size == 1:
        return values.cpu().tolist()  # type: ignore[no-any-return]
    total = _reduced(values.detach().clone(), dist.ReduceOp.SUM)
    return [value / size for value in total]


def largest(value: int) -> int:
    """Return the largest value over all ranks. All ranks must call it together."""
    return value if group_size() == 1 else int(_reduced(torch.tensor([value]), dist.ReduceOp.MAX)[0])


def _lowest(vote: int, device: torch.device | None) -> int:
    at = device if device is not None and device.type in _devices() and "cpu" not in _devices() else "cpu"
    return int(_reduced(torch.tensor([vote], dtype=torch.int32, device=at), dist.ReduceOp.MIN)[0])


def _reduced(values: Tensor, operation: Any) -> list[float]:
    """Reduce values over all ranks, on a device that the group supports, and return them."""
    group = None
    if values.device.type not in _devices():
        values = values.cpu()
        if "cpu" not in _devices():
            group = _gloo_group()
    try:
        dist.all_reduce(values, op=operation, group=group)
        return values.cpu().tolist()  # type: ignore[no-any-return]
    except RuntimeError as error:  # NCCL reports a missing peer only when the result is read
        raise SkipGSError(
            "Another process of the group did not answer: it ended, or waited longer than the time-out of "
            "init_process_group(); see its output, and resume all from their last checkpoint. PyTorch says: "
            f"{str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__}"
        ) from error


def _devices() -> set[str]:
    """Return the types of devices whose tensors the process group accepts, such as "cpu" and "cuda"."""
    return {str(torch.device(one).type) for one in _world()._device_types}


def _world() -> Any:
    return dist.group.WORLD


# Our gloo group by the trainer's group. Both references are weak: `destroy_process_group` must be able to end our
# group's threads. A group that lives until the interpreter ends can abort the process there.
_own_groups: weakref.WeakKeyDictionary[Any, weakref.ref[Any]] = weakref.WeakKeyDictionary()


def _gloo_group() -> Any:
    """Return a CPU group for a process group without one, such as `cuda:nccl`; all ranks create it together."""
    world = _world()
    own = _own_groups[world]() if world in _own_groups else None
    if own is None:
        own = dist.new_group(backend="gloo")  # PyTorch holds it until `destroy_process_group`
        _own_groups[world] = weakref.ref(own)
    return own
