"""Processes that train together while one of them disagrees, lags, hangs or dies: how the others end, and how soon."""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import sys
import time
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from skipgs_plug import SkipGate, SkipGSError

TIME_OUT = 5.0  # time-out of the process group, in seconds
STEPS, AT = 60, 30  # iterations, and the one at which the second process fails
LATE = {"disagree": 0.0, "lag": 2.0, "hang": 3 * TIME_OUT}  # seconds that it then waits


def train_together(folder: Path, size: int, kind: str) -> dict[str, Any]:
    """Train a parameter in `size` gloo processes, of which the second fails half way.

    Returns:
        `seconds` from the failure to the end of the last healthy process, and the messages at their `endings`.

    Raises:
        RuntimeError: A process hung, or ended without the message that it should give.
    """
    folder.mkdir()
    context = mp.get_context("spawn")
    ranks = [context.Process(target=_rank, args=(rank, str(folder), size, kind)) for rank in range(size)]
    for rank in ranks:
        rank.start()
    for rank in ranks:
        rank.join(120)
    if any(rank.is_alive() for rank in ranks):
        for rank in ranks:
            rank.kill()
        raise RuntimeError(f"{kind}, {size} processes: one hangs")
    troubled = float((folder / "trouble").read_text())
    healthy = [folder / f"{rank}.txt" for rank in range(size) if rank != 1]
    seconds, endings = zip(*(path.read_text().split("\n", 1) for path in healthy), strict=True)
    expected = "done" if kind in ("disagree", "lag") else "did not answer"
    if not all(expected in ending for ending in endings):
        raise RuntimeError(f"{kind}, {size} processes: {endings}")
    return {"seconds": max(float(one) for one in seconds) - troubled, "endings": sorted(set(endings))}


def _rank(rank: int, folder: str, size: int, kind: str) -> None:
    torch.set_num_threads(1)
    if sys.platform == "linux":
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")  # containers may not resolve their own host name
    rendezvous = f"file://{folder}/rendezvous"
    dist.init_process_group(
        "gloo", init_method=rendezvous, rank=rank, world_size=size, timeout=timedelta(seconds=TIME_OUT)
    )
    gate = SkipGate(start_iter=0, warmup=5)
    parameter = torch.nn.Parameter(torch.ones(1))
    parameter.register_hook(lambda grad: (dist.all_reduce(grad := grad.clone()), grad)[1])  # as DDP does
    ending = "done"
    try:
        for step in range(STEPS):
            if (rank, step) == (1, AT):
                Path(folder, "trouble").write_text(str(time.time()))
                if kind == "die":
                    os.kill(os.getpid(), signal.SIGKILL)
                time.sleep(LATE[kind])
            # Losses differ between processes, which disagree about every second decision.
            loss = parameter.sum() * (1.0 + 0.3 * ((7 * step + 5 * rank) % 11 - 5) / 5)
            if gate.backward(loss, view=step % 3, step=step):
                parameter.grad = None
    except (SkipGSError, RuntimeError) as error:
        ending = str(error)
    Path(folder, f"{rank}.txt").write_text(f"{time.time()}\n{ending}")
    os._exit(0)  # an orderly exit would wait for dead processes of the group
