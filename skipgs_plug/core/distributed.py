"""Several processes: either all ranks run the backward pass of an iteration or no rank does, else collectives hang."""

from __future__ import annotations

import contextlib
import itertools
import os
import time
import weakref
from collections.abc import Iterator
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from skipgs_plug.core import decision
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.errors import BrokenTrainingError, SkipGSError

# Smallest wins: one rank's error ends the training or releases the gates of all, one poisoned loss is left out by all,
# one backward makes all run.
_END, _RELEASE, _POISONED, _RUN, _SKIP = range(5)

_failures = itertools.count()  # number of the next call of `all_failed`

# Seconds for which a rank waits in its first iteration until all ranks have gates. Before, they load the same scene.
GATES_AWAITED = 120.0

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


def require_gates() -> None:
    """Raise SkipGSError unless all processes that train together have gates. All ranks must call it before they train.

    A launcher that starts a script again, such as Lightning's, leaves its copies without gates. Their reductions would
    meet those of the gates. The ranks meet once in a process group, through its store.
    """
    refuse_unreachable_ranks()
    size = group_size()
    if size == 1 or _world() in _have_gates:
        return
    store = dist.distributed_c10d._get_default_store()
    if store is None:  # MPI starts all ranks with the same command
        return
    shown = [f"skipgs_plug/gate of rank {rank}" for rank in range(size)]
    end = time.monotonic() + GATES_AWAITED
    with _answered():
        store.set(shown[dist.get_rank()], "1")
        while not store.check(shown) and time.monotonic() < end:
            time.sleep(0.01)
        missing = [str(rank) for rank in range(size) if not store.check([shown[rank]])]
    if missing:
        sentence = (
            f"{size} processes train together, and rank {', '.join(missing)} began no iteration with a gate within "
            f"{GATES_AWAITED:g} s"
        )
        start = f"torchrun --nproc_per_node {size} -m skipgs_plug run"
        raise SkipGSError(
            f"{sentence}; create a gate in every process, or train in one process.",
            in_script=f"{sentence}; start all by {start} ADAPTER -- SCRIPT, or train in one process.",
        )
    _have_gates.add(_world())


def refuse_several(because: str, instead: str) -> None:
    """Raise SkipGSError if several processes train together; its sentence is made of `because` and `instead`."""
    if group_size() > 1:
        raise SkipGSError(f"{because}, but {group_size()} train together; {instead}.")


def agree(own: Decision, device: torch.device | None = None) -> Decision | None:
    """Combine this rank's decision with those of all others: skip only if every rank would.

    Args:
        own: Decision of this rank.
        device: Device of the loss, to which votes go if the group has no CPU backend; None for a plain number.

    Returns:
        The decision of all ranks; None if the gate of another rank is released, and this one must be too.

    Raises:
        BrokenTrainingError: Another rank stopped with an error, or does not answer.
    """
    vote = _SKIP if own.skip else _RUN
    lowest = _lowest(_POISONED if own is decision.NON_FINITE else vote, device)
    if lowest == _END:
        raise BrokenTrainingError("The gate of another process stopped with an error; see its output.")
    if lowest == _RELEASE:
        return None
    if lowest == _POISONED:
        return decision.NON_FINITE
    if lowest == _RUN and own.skip:
        return decision.OTHER_RANK
    return own


def tell_error(ends: bool, device: torch.device | None = None) -> None:
    """Tell the other ranks, in place of a vote, about an error on this rank. They may have ended already.

    Args:
        ends: Whether the error ends the training. Otherwise, the gates of all ranks are released.
        device: See `agree`.
    """
    with contextlib.suppress(SkipGSError):
        _lowest(_END if ends else _RELEASE, device)


def all_failed(step: int | None) -> bool:
    """Return whether all ranks meet an error of the gate's own code in iteration `step`.

    A rank calls it after such an error, and waits for the others, at most for the time-out of `init_process_group`. It
    tells them through the store of the group, because a reduction could meet one of the trainer's.
    """
    size = group_size()
    if size == 1:
        return True
    store = dist.distributed_c10d._get_default_store()
    number = next(_failures)
    said = [f"skipgs_plug/error {number} in iteration {step} on rank {rank}" for rank in range(size)]
    try:
        store.set(said[dist.get_rank()], "1")
        store.wait(said)
    except RuntimeError:  # the time is over, or the rank that holds the store has ended
        return False
    return True


def mean(values: Tensor) -> list[float]:
    """Return the mean of each value [K] over all ranks, with one read of the device. All ranks must call it together.

    Raises:
        BrokenTrainingError: Another rank does not answer.
    """
    size = group_size()
    if size == 1:
        return values.cpu().tolist()  # type: ignore[no-any-return]
    total = _reduced(values.detach().clone(), dist.ReduceOp.SUM)
    return [value / size for value in total]


def largest(value: int) -> int:
    """Return the largest value over all ranks. All ranks must call it together."""
    return value if group_size() == 1 else int(_reduced(torch.tensor([value]), dist.ReduceOp.MAX)[0])


def united(found: dict[str, set[int]]) -> dict[str, set[int]]:
    """Return the sets of all ranks, with those of one name united. All ranks must call it together.

    Raises:
        BrokenTrainingError: Another rank does not answer.
    """
    size = group_size()
    if size == 1:
        return found
    require_gates()  # conditions are read before the first iteration
    of_ranks: list[Any] = [None] * size
    with _answered():
        dist.all_gather_object(of_ranks, found, group=None if "cpu" in _devices() else _gloo_group())
    names = dict.fromkeys(name for one in of_ranks for name in one)
    return {name: set().union(*(one.get(name, ()) for one in of_ranks)) for name in names}


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
    with _answered():  # NCCL reports a missing peer only when the result is read
        dist.all_reduce(values, op=operation, group=group)
        return values.cpu().tolist()  # type: ignore[no-any-return]


@contextlib.contextmanager
def _answered() -> Iterator[None]:
    """Raise BrokenTrainingError if another rank does not answer in the `with` statement."""
    try:
        yield
    except RuntimeError as error:
        raise BrokenTrainingError(
            "Another process of the group did not answer: it ended, or waited longer than the time-out of "
            "init_process_group(); see its output, and resume all from their last checkpoint. PyTorch says: "
            f"{str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__}"
        ) from error


def _devices() -> set[str]:
    """Return the types of devices whose tensors the process group accepts, such as "cpu" and "cuda"."""
    return {str(torch.device(one).type) for one in _world()._device_types}


def _world() -> Any:
    return dist.group.WORLD


_have_gates: weakref.WeakSet[Any] = weakref.WeakSet()  # process groups whose ranks all have gates

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
