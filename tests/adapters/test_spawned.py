"""A script that spawns a process for each device, as gsplat's does: a gate in each of them, on the CPU with gloo."""

import json
import socket
import sys
import textwrap
from pathlib import Path

import pytest

from skipgs_plug import cli

DISTRIBUTED = """
    import os, torch

    def _distributed_worker(world_rank, world_size, fn, args):
        torch.distributed.init_process_group("gloo", world_size=world_size, rank=world_rank)
        fn(world_rank, world_rank, world_size, args)
        torch.distributed.barrier()
        torch.distributed.destroy_process_group()

    def cli(fn, args, verbose=False):
        torch.multiprocessing.spawn(_distributed_worker, args=(2, fn, args), nprocs=2)
"""
SCRIPT = """
    import json, os, sys
    import torch
    from gsplat.distributed import cli
    from lookalikes import gsplat_runner
    from lookalikes.splats import log, new_log

    class Runner(gsplat_runner.Runner):
        def train(self, *args, **kwargs):
            super().train(*args, **kwargs)

    def main(local_rank, world_rank, world_size, cfg):
        new_log()
        if world_rank == 1:  # losses that jump, unlike those of the first process
            plain = gsplat_runner.photo_loss
            gsplat_runner.photo_loss = lambda image, camera: plain(image, camera) * (2 if log.now % 7 == 0 else 1)
        Runner(gsplat_runner.DefaultStrategy(), world_size=world_size, result_dir=cfg).train()
        with open(os.path.join(cfg, f"rank{world_rank}.json"), "w") as file:
            json.dump(log.backwards, file)
        if "--fail" in sys.argv:
            sys.exit(3)

    if __name__ == "__main__":
        cli(main, sys.argv[1])
"""


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)
    for name, text in (("gsplat/__init__.py", ""), ("gsplat/distributed.py", DISTRIBUTED), ("train.py", SCRIPT)):
        file = tmp_path / "checkout" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(textwrap.dedent(text))
    monkeypatch.setenv("MASTER_ADDR", "localhost")
    with socket.socket() as free:
        free.bind(("localhost", 0))
        monkeypatch.setenv("MASTER_PORT", str(free.getsockname()[1]))
    others = {name: module for name, module in sys.modules.items() if name.split(".")[0] == "gsplat"}
    for name in others:
        monkeypatch.delitem(sys.modules, name)
    yield str(tmp_path / "checkout" / "train.py")
    for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
        del sys.modules[name]


def test_every_spawned_process_is_gated_and_all_agree(checkout, tmp_path, capfd):
    code = cli.main(["run", "gsplat", "--warmup", "3", "--pause-iters", "4", "--", checkout, str(tmp_path)])
    output = capfd.readouterr()
    assert code == 0, output.err
    report = json.loads((tmp_path / "skipgs.json").read_text())
    assert report["iterations"] == 60 and report["backwards_skipped"] > 0
    ranks = [json.loads((tmp_path / f"rank{rank}.json").read_text()) for rank in (0, 1)]
    assert ranks[0] == ranks[1] and len(ranks[0]) == 60 - report["backwards_skipped"]
    assert output.err.count("SkipGS: ") == 1 and "nothing was gated" not in output.err
    assert "other rank" in report["reasons"]  # a rank that would have skipped alone ran


def test_process_that_fails_fails_the_run(checkout, tmp_path, capfd):
    assert cli.main(["run", "gsplat", "--no-gate", "--", checkout, str(tmp_path), "--fail"]) == 1
    assert "ProcessExitedException" in capfd.readouterr().err
