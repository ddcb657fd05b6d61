"""Several processes: all ranks run the backward of an iteration, or none, else its collectives hang."""

from __future__ import annotations

import contextlib
import os

import torch
import torch.distributed as dist

from skipgs_plug.core import decision
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.errors import SkipGSError

# Smallest wins: one rank's error stops all, one poisoned loss is left out by all, one backward makes all run.
_ABORT, _POISONED, _RUN, _SKIP = range(4)


def group_size() -> int:
    """Number of processes that train together; 1 without torch.distributed."""
    if dist.is_available() and dist.is_initialized():
        return dist.get_world_size()
    return 1


def refuse_unreachable_ranks(world_size: int | None = None) -> None:
    """Raise SkipGSError when there are other processes but no group to agree with them through."""
    world = int(os.environ.get("WORLD_SIZE") or 1) if world_size is None else world_size
    if world > 1 and group_size() == 1:
        raise SkipGSError(
            f"{world} processes train together, but torch.distributed is not initialised, so their gates "
            "cannot agree; call init_process_group() first, or train in one process."
        )


def refuse_several(because: str, instead: str) -> None:
    """Raise SkipGSError when several processes train together, for a reason given as half a sentence."""
    if group_size() > 1:
        raise SkipGSError(f"{because}, but {group_size()} train together; {instead}.")


def agree(own: Decision) -> Decision:
    """Reduce this rank's decision with those of all others: skip only when every rank would.

    Raises:
        SkipGSError: Another rank stopped with an error, or does not answer.
    """
    vote = _SKIP if own.skip else _RUN
    lowest = _lowest(_POISONED if own is decision.NON_FINITE else vote)
    if lowest == _ABORT:
        raise SkipGSError("The gate of another process stopped with an error; see its output.")
    if lowest == _POISONED:
        return decision.NON_FINITE
    if lowest == _RUN and own.skip:
        return decision.OTHER_RANK
    return own


def abort() -> None:
    """Tell the other ranks that this one raises, so that they do not wait for it; they may be gone themselves."""
    with contextlib.suppress(SkipGSError):
        _lowest(_ABORT)


def _lowest(vote: int) -> int:
    device = "cuda" if dist.get_backend() == "nccl" else "cpu"
    votes = torch.tensor(vote, dtype=torch.int32, device=device)
    try:
        dist.all_reduce(votes, op=dist.ReduceOp.MIN)
        return int(votes)
    except RuntimeError as error:  # also of NCCL, which reports a peer that is gone when the result is read
        raise SkipGSError(
            "Another process of the group did not answer: it ended, or waited longer than the time-out of "
            "init_process_group(); see its output, and resume all from their last checkpoint."
        ) from error
