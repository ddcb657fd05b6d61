"""Two processes whose losses disagree: no hang, and the same decisions on both."""

from __future__ import annotations

import json
import math
import os
import random
import signal
import sys
import time
import warnings
from collections.abc import Hashable
from datetime import timedelta
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist

# The functions of this module have the process group as a default argument. PyTorch imports it at an optimizer's first
# step. A group that exists by then lives until the interpreter's end, and its threads can abort the process there.
import torch.distributed.nn
import torch.multiprocessing as mp

from skipgs_plug import Decision, SkipGate, SkipGSError
from skipgs_plug.core import decision, distributed
from skipgs_plug.core.engine import Engine
from skipgs_plug.core.pace.phased import Phased
from skipgs_plug.core.pace.refinement_policy import RefinementPolicy
from skipgs_plug.core.policy import SkipPolicy

STEPS = 300


def start(rank: int, folder: str, size: int = 2, seconds: float = 60) -> None:
    torch.set_num_threads(1)
    if sys.platform == "linux":
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")  # containers may not know their own host name
    dist.init_process_group(
        "gloo",
        init_method=f"file://{folder}/rendezvous",
        rank=rank,
        world_size=size,
        timeout=timedelta(seconds=seconds),
    )


def train(rank: int, folder: str) -> None:
    """Each rank draws its own losses; the gradient is reduced in every backward, as DDP would."""
    start(rank, folder)
    draw = random.Random(rank)
    parameter = torch.nn.Parameter(torch.ones(1))
    parameter.register_hook(lambda grad: (dist.all_reduce(grad := grad.clone()), grad)[1])
    gate = SkipGate(start_iter=20, warmup=20, record_trace=True)
    gradients = []
    for step in range(STEPS):
        scale = draw.uniform(0.5, 1.5)
        if (rank, step) == (1, 150):
            scale = math.nan
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            if gate.backward(parameter.sum() * scale, view=f"v{step % 3}", step=step):
                gradients.append(parameter.grad.item())
                parameter.grad = None
    result = {
        "skips": [row.skip for row in gate.trace],
        "reasons": [row.reason for row in gate.trace],
        "gradients": gradients,
        "recorded": [gate.policy.budget.backwards, gate.policy.budget.skips],
    }
    Path(folder, f"{rank}.json").write_text(json.dumps(result))
    dist.destroy_process_group()


def fail_on_one(rank: int, folder: str) -> None:
    start(rank, folder)
    gate = SkipGate(start_iter=0, on_nonfinite="raise")
    loss = torch.ones(1, requires_grad=True).sum() * (math.nan if rank else 1.0)
    try:
        gate.backward(loss, view="a", step=0)
    except SkipGSError as error:
        Path(folder, f"{rank}.txt").write_text(str(error))
    dist.destroy_process_group()


@pytest.mark.timeout(120)
def test_ranks_agree(tmp_path: Path) -> None:
    mp.spawn(train, args=(str(tmp_path),), nprocs=2)
    one, two = (json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2))
    assert one["skips"] == two["skips"]
    assert any(one["skips"])
    assert one["gradients"] == two["gradients"]
    assert all(math.isfinite(gradient) for gradient in one["gradients"])
    assert len(one["gradients"]) == 20 + one["skips"].count(False)
    # The ranks disagreed, each at some time, and the backward pass ran on both.
    assert "other rank" in one["reasons"]
    assert "other rank" in two["reasons"]
    assert one["reasons"][130] == two["reasons"][130] == "non-finite"
    # The policy counts the backwards that ran and those that were skipped, except in the poisoned iteration.
    assert one["recorded"] == two["recorded"] == [one["skips"].count(False), one["skips"].count(True) - 1]


@pytest.mark.timeout(120)
def test_an_error_on_one_rank_ends_both(tmp_path: Path) -> None:
    mp.spawn(fail_on_one, args=(str(tmp_path),), nprocs=2)
    assert "view 'a'" in (tmp_path / "1.txt").read_text()
    assert "another process" in (tmp_path / "0.txt").read_text()


def trouble(rank: int, folder: str, size: int, kind: str, loaded: Barrier) -> None:
    """Rank 1 dies, stops answering, or is late; says how each rank ended."""
    loaded.wait()  # loading torch takes longer than 3 s on a busy machine
    start(rank, folder, size, seconds=3)
    gate = SkipGate(start_iter=0, warmup=2)
    parameter = torch.nn.Parameter(torch.ones(1))
    said = "done"
    try:
        for step in range(20):
            if (rank, step) == (1, 10):
                if kind == "dies":
                    os.kill(os.getpid(), signal.SIGKILL)
                time.sleep({"lags": 1, "hangs": 6}[kind])
            gate.backward(parameter.sum() * (rank + 1), view="a", step=step)
    except SkipGSError as error:
        said = str(error)
    Path(folder, f"{rank}.txt").write_text(said)
    os._exit(0)  # an orderly exit would wait for the dead rank


@pytest.mark.timeout(120)
@pytest.mark.parametrize(("kind", "size"), [("lags", 2), ("dies", 2), ("hangs", 2), ("dies", 4)])
def test_ranks_in_trouble_end_within_the_time_out(tmp_path: Path, kind: str, size: int) -> None:
    context = mp.get_context("spawn")
    loaded = context.Barrier(size, timeout=60)
    ranks = [context.Process(target=trouble, args=(rank, str(tmp_path), size, kind, loaded)) for rank in range(size)]
    for rank in ranks:
        rank.start()
    for rank in ranks:
        rank.join(60)
    assert not any(rank.is_alive() for rank in ranks)
    said = {rank: (tmp_path / f"{rank}.txt").read_text() for rank in range(size) if (tmp_path / f"{rank}.txt").exists()}
    assert said.keys() == set(range(size)) - ({1} if kind == "dies" else set())
    if kind == "lags":
        assert set(said.values()) == {"done"}
    else:
        assert all("did not answer" in sentence for sentence in said.values())


def release(rank: int, folder: str, place: str, ranks: tuple[int, ...]) -> None:
    """Make the gate's own code fail at a place on some ranks, from iteration 60 on; report the result of each rank."""
    start(rank, folder, seconds=5)
    owner, name, share = PLACES[place]
    now, original = 0, getattr(owner, name)

    def fails(*args: Any) -> Any:
        if now >= 60 and rank in ranks:
            raise ZeroDivisionError(f"of {name}")
        return original(*args)

    setattr(owner, name, fails)
    parameter = torch.nn.Parameter(torch.ones(1))
    parameter.register_hook(lambda grad: (dist.all_reduce(grad := grad.clone()), grad)[1])
    papers = {"warmup": 5, "min_bwd_ratio": 0.0} if share is None else {"refine_share": share}
    gate = SkipGate(start_iter=20, compensate=False, **papers)
    ran, said, poison = [], "", 1.0
    try:
        for now in gate.iterations(range(200), always=[60]):
            poison = math.nan if place == "losses" and now >= 60 and rank in ranks else 1.0
            with warnings.catch_warnings(record=True):
                warnings.simplefilter("always")
                if gate.backward(parameter.sum() * poison, view=f"v{now % 3}", step=now):
                    ran.append(now)
    except (ZeroDivisionError, SkipGSError) as error:
        said = str(error)
    Path(folder, f"{rank}.json").write_text(json.dumps({"ran": ran, "said": said, "released": gate.released}))
    os._exit(0)  # an orderly exit would wait for the other rank


# Function of the gate that fails, and the gate's refine_share, by name. None: losses are not finite.
PLACES: dict[str, Any] = {
    "decision": (SkipPolicy, "decide", None),
    "decision with a share": (RefinementPolicy, "decide", 0.5),
    "iteration": (Engine, "open_iteration", None),
    "number": (Phased, "_runs", 0.5),
    "losses": (SkipPolicy, "notify_event", None),
}


def released(folder: Path, place: str, ranks: tuple[int, ...]) -> list[dict[str, Any]]:
    context = mp.get_context("spawn")
    processes = [context.Process(target=release, args=(rank, str(folder), place, ranks)) for rank in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
    assert not any(process.is_alive() for process in processes)
    return [json.loads((folder / f"{rank}.json").read_text()) for rank in range(2)]


@pytest.mark.timeout(120)
@pytest.mark.parametrize(
    ("place", "ranks"),
    [
        ("decision", (1,)),
        ("decision with a share", (1,)),
        ("iteration", (0, 1)),
        ("number", (0, 1)),
    ],
)
def test_an_error_of_the_gate_releases_it_on_all_ranks_together(
    tmp_path: Path, place: str, ranks: tuple[int, ...]
) -> None:
    one, two = released(tmp_path, place, ranks)
    assert one["ran"] == two["ran"] and len(one["ran"]) < 200
    assert [step for step in one["ran"] if step >= 60] == list(range(60, 200))
    for rank, end in enumerate((one, two)):
        assert end["said"] == "" and "The gate is released in iteration" in end["released"]
        cause = "ZeroDivisionError: of" if rank in ranks else "the gate of another process is released"
        assert cause in end["released"]


@pytest.mark.timeout(120)
def test_losses_that_stay_non_finite_on_one_rank_end_loops_of_ones_own_on_all(tmp_path: Path) -> None:
    one, two = released(tmp_path, "losses", ranks=(1,))
    assert one["ran"] == two["ran"] and max(one["ran"]) < 70
    assert "like the 9 losses before it" in two["said"] and one["said"] and one["released"] is None


def train_beside_no_gate(rank: int, folder: str, share: float | None) -> None:
    """Rank 1 has no gate, like the processes in which Lightning 2.6.6 runs a script (`Fabric(devices=2)`) again."""
    start(rank, folder, seconds=20)
    distributed.GATES_AWAITED = 1.0
    parameter = torch.nn.Parameter(torch.ones(1))
    try:
        gate = None if rank else SkipGate(start_iter=20, share=share)
        for step in range(40) if gate is None else gate.iterations(range(40), events=[5, 10]):
            if gate is None:
                parameter.sum().backward()
            else:
                gate.backward(parameter.sum(), view=f"v{step % 3}", step=step)
            dist.all_reduce(parameter.grad)
    except RuntimeError as error:  # on rank 1 the error of a group whose other process has ended
        Path(folder, f"{rank}.txt").write_text(str(error))
    os._exit(0)  # a broken group is not left in order


@pytest.mark.timeout(120)
@pytest.mark.parametrize("share", [None, 0.5])
def test_a_rank_without_a_gate_is_refused_before_training(tmp_path: Path, share: float | None) -> None:
    mp.spawn(train_beside_no_gate, args=(str(tmp_path), share), nprocs=2)
    said = (tmp_path / "0.txt").read_text()
    assert said.startswith("2 processes train together, and rank 1 began no iteration with a gate within 1 s; create")
    assert (tmp_path / "1.txt").exists()


class Inactive(SkipPolicy):
    """A policy that begins later than the gate."""

    def decide(self, view: Hashable, loss: float, step: int) -> Decision:
        return decision.INACTIVE


def never_begin(rank: int, folder: str) -> None:
    start(rank, folder)
    gate = SkipGate(start_iter=0, policy=Inactive(start_iter=0))
    for step in range(3):
        gate.backward(torch.ones(1, requires_grad=True).sum(), view="a", step=step)
    Path(folder, f"{rank}.txt").write_text(str(gate.released))
    dist.destroy_process_group()


@pytest.mark.timeout(120)
def test_a_policy_that_has_not_begun_releases_no_gate(tmp_path: Path) -> None:
    mp.spawn(never_begin, args=(str(tmp_path),), nprocs=2)
    assert [(tmp_path / f"{rank}.txt").read_text() for rank in range(2)] == ["None", "None"]


@pytest.mark.timeout(120)
def test_an_error_of_which_the_other_rank_does_not_hear_ends_both(tmp_path: Path) -> None:
    one, two = released(tmp_path, "number", ranks=(1,))
    assert two["said"] == "of _runs" and "did not answer" in one["said"]
    assert one["released"] is None and two["released"] is None


def refine(rank: int, folder: str, share: float | str, nothing_on_the_cpu: bool) -> None:
    """Replicas whose views show different shares of the Gaussians, and whose reduced gradients are the same."""
    start(rank, folder)
    if nothing_on_the_cpu:
        distributed._devices = lambda: {"cuda"}  # the answer of a group of cuda:nccl
    torch.manual_seed(0)
    value = torch.nn.Parameter(torch.zeros(40, 3))
    optimizer = torch.optim.Adam([{"params": [value], "lr": 0.01, "name": "means"}])
    goal = torch.randn(40, 3)
    gate = SkipGate(start_iter=20, refine_share=share)
    ran = []
    for step in gate.iterations(range(600), views=[f"{view}.png" for view in range(40)]):
        ran.append(step)
        seen = torch.zeros(40, 1)
        seen[: 10 + 25 * rank] = 1.0
        loss = ((value - goal).abs() * seen).mean()
        if gate.backward(loss, view=f"{(step * 2 + rank) % 40}.png", step=step):
            optimizer.step()
            optimizer.zero_grad()
            with torch.no_grad():
                dist.all_reduce(value)
                value /= 2
    report = gate.report()
    result = {"ran": ran, "shown": report["gaussians_shown"], "share": report["refine_share"], "end": value.tolist()}
    Path(folder, f"{rank}.json").write_text(json.dumps(result))
    dist.destroy_process_group()
    # If the gate's group outlived the trainer's, it would end with the interpreter, and could abort it.
    assert not any(own() for own in distributed._own_groups.values())


@pytest.mark.timeout(120)
@pytest.mark.parametrize("share, nothing_on_the_cpu", [(0.4, False), ("auto", False), (0.4, True)])
def test_ranks_agree_on_what_views_show(tmp_path: Path, share: float | str, nothing_on_the_cpu: bool) -> None:
    mp.spawn(refine, args=(str(tmp_path), share, nothing_on_the_cpu), nprocs=2)
    one, two = (json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2))
    assert one == two and 20 < len(one["ran"]) < 600
    assert one["shown"] == pytest.approx((0.25 + 0.875) / 2)


def grow(rank: int, folder: str, bound: int | None) -> None:
    """Ranks that hold different numbers of Gaussians, as gsplat's do, which deals them out."""
    start(rank, folder)
    held = 40 + 30 * rank
    torch.manual_seed(rank)
    means = torch.nn.Parameter(torch.randn(held, 3))
    optimizer = torch.optim.Adam([{"params": [means], "lr": 0.01, "name": "means"}])
    gate = SkipGate(start_iter=400, share=0.5, max_gaussians=bound)
    ran = []
    for step in gate.iterations(range(500), views=[f"{view}.png" for view in range(8)], events=range(20, 400, 20)):
        ran.append(step)
        if gate.backward(means.square().mean(), view=f"{(step * 2 + rank) % 8}.png", step=step):
            optimizer.step()
            optimizer.zero_grad()
    grown = gate.report()["growing"]
    Path(folder, f"{rank}.json").write_text(json.dumps({"ran": ran, "events": grown["events_run"]}))
    dist.destroy_process_group()


@pytest.mark.timeout(120)
@pytest.mark.parametrize("bound, events", [(60, False), (None, True)])  # only the second rank has more than 60
def test_ranks_agree_on_the_bound_on_gaussians(tmp_path: Path, bound: int | None, events: bool) -> None:
    mp.spawn(grow, args=(str(tmp_path), bound), nprocs=2)
    one, two = (json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2))
    # The first event comes before a step has shown the number of Gaussians.
    assert one == two and (one["events"] > 1) == events


def save_on_the_first(rank: int, folder: str) -> None:
    """The first rank alone saves, and its condition on the number names no iteration to the other one."""
    start(rank, folder, seconds=5)
    parameter = torch.nn.Parameter(torch.ones(1))
    parameter.register_hook(lambda grad: (dist.all_reduce(grad := grad.clone()), grad)[1])
    optimizer = torch.optim.Adam([{"params": [parameter], "lr": 0.01, "name": "means"}])
    gate = SkipGate(start_iter=20, refine_share=0.3)
    ran, saved = [], []
    for step in gate.iterations(range(200), views=["a.png", "b.png"]):
        ran.append(step)
        if gate.backward(parameter.square().sum(), view="ab"[step % 2] + ".png", step=step):
            optimizer.step()
            optimizer.zero_grad()
        if rank == 0 and step % 35 == 0:
            saved.append(step)
    Path(folder, f"{rank}.json").write_text(json.dumps({"ran": ran, "saved": saved}))
    dist.destroy_process_group()


@pytest.mark.timeout(120)
def test_ranks_run_the_iterations_that_one_of_them_needs(tmp_path: Path) -> None:
    mp.spawn(save_on_the_first, args=(str(tmp_path),), nprocs=2)
    one, two = (json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2))
    assert one["ran"] == two["ran"] and len(one["ran"]) < 120
    assert one["saved"] == [0, 35, 70, 105, 140, 175] and two["saved"] == []
