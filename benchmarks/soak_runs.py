"""Training runs that are killed, stopped or out of disk space, then resumed, and compared with an undisturbed run."""

from __future__ import annotations

import errno
import json
import multiprocessing as mp
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch

from skipgs_plug.files import LEFTOVER
from skipgs_plug.trainer import save_packed
from skipgs_plug.trainer.synthetic import make_scene

STEPS = 80  # iterations of a run
OPTIONS = ["--max-steps", str(STEPS), "--refine-every", "10", "--no-progress"]
GATED = ["--warmup", "8"]
DECIDED = ("iterations", "gated_iterations", "backwards_run", "backwards_skipped", "reasons", "events", "views")
CURVE = "stats/train_curve.json"
LIMIT = 120.0  # seconds after which a run counts as hung; it usually takes a few
FAULTS = ("killed before", "killed after", "disk full")  # faults when a file is renamed to its final name

# The fork server imports packages once, including those that torch's optimizers load. A run forked from it starts in a
# fraction of a second.
PRELOADED = (
    "skipgs_plug.commands.train skipgs_plug.fallback_raster warp gsplat torch._dynamo torchmetrics scipy.spatial"
)
CONTEXT = mp.get_context("forkserver")
CONTEXT.set_forkserver_preload([*PRELOADED.split(), "filelock", "plyfile", "PIL.PngImagePlugin", "tqdm", "yaml"])


def make_tiny_scene(folder: Path) -> Path:
    """Write a scene of ten views of 32x24 pixels and 160 points."""
    path = folder / "tiny.npz"
    save_packed(make_scene(n_views=10, width=32, height=24, n_points=160), path)
    return path


class Run:
    """A run folder, and the command that trains in it. The command may be started several times.

    Args:
        scene: File written by `make_tiny_scene`.
        out: The run folder.
        gated: Whether to train with the gate.
        save_every: Iterations between two checkpoints.
    """

    def __init__(self, scene: Path, out: Path, gated: bool, save_every: int) -> None:
        self.out = out
        self._command = ["train", str(scene), "--out", str(out), *OPTIONS, "--save-every", str(save_every)]
        self._command += GATED if gated else []
        self.starts = 0

    def start(self, fault: tuple[str, int] | None = None) -> BaseProcess:
        """Start the command, with --resume if there is a checkpoint.

        Args:
            fault: One of FAULTS, and the number of the file at which it occurs.
        """
        resume = ["--resume"] if any((self.out / "ckpts").glob("ckpt_*.pt")) else []
        log = self.out.with_suffix(".log")
        log.touch()  # a signal may come before the process opens it
        process = CONTEXT.Process(target=_child, args=([*self._command, *resume], str(log), fault))
        process.start()
        self.starts += 1
        return process

    def finish(self) -> None:
        """Run to the end without a fault.

        Raises:
            RuntimeError: The run failed or hung.
        """
        self.expect(self.start(), {0})

    def expect(self, process: BaseProcess, codes: set[int]) -> int:
        """Wait for a process and return its exit code. A negative code is a signal.

        Raises:
            RuntimeError: The process ended with another code, printed a traceback, or hung.
        """
        process.join(LIMIT)
        code = process.exitcode
        said = self.out.with_suffix(".log").read_text()
        if code is None:
            process.kill()
        if code not in codes or "Traceback" in said:
            raise RuntimeError(f"{self.out.name}: ended with {code} instead of {sorted(codes)}\n{said[-3000:]}")
        return code

    def half_written(self) -> int:
        """Return the number of temporary files that killed processes left behind."""
        return sum(1 for path in self.out.rglob(".*") if LEFTOVER.fullmatch(path.name))


def _child(command: list[str], log: str, fault: tuple[str, int] | None) -> None:
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)
    if fault is not None:
        _strike(*fault)
    from skipgs_plug.cli import main

    sys.exit(main(command))


def _strike(kind: str, at: int) -> None:
    replace, count = os.replace, 0

    def struck(source: Any, target: Any) -> None:
        nonlocal count
        count += 1
        if count != at:
            replace(source, target)
        elif kind == "disk full":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(source))
        else:
            if kind == "killed after":
                replace(source, target)
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = struck  # type: ignore[assignment]


def assert_same(out: Path, whole: Path, steps: int = STEPS) -> None:
    """Raise AssertionError unless two runs of `steps` iterations have the same files, models, moments and decisions."""
    last = f"ckpts/ckpt_{steps - 1}_rank0.pt"
    left = [{p.relative_to(r).as_posix() for p in r.rglob("*") if p.is_file()} for r in (out, whole)]
    left = [{name for name in names if not name.startswith("ckpts/") or name == last} for names in left]
    assert left[0] == left[1], left[0] ^ left[1]
    for name in left[0]:
        if name == CURVE:  # seconds differ between runs
            curves = [json.loads((run / name).read_text()) | {"seconds": None} for run in (out, whole)]
            assert curves[0] == curves[1], name
        elif name.startswith("stats/"):
            stats = [json.loads((run / name).read_text()) for run in (out, whole)]
            stats = [{key: value for key, value in one.items() if not key.startswith("t_")} for one in stats]
            assert stats[0] == stats[1], name
        elif name.startswith(("ply/", "renders/")):
            assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    one, two = (torch.load(run / last, weights_only=True) for run in (out, whole))
    for part in ("splats", "optimizers", "strategy"):
        _assert_equal(one[part], two[part], part)
    if (whole / "skipgs.json").exists():
        reports = [json.loads((run / "skipgs.json").read_text()) for run in (out, whole)]
        for key in DECIDED:
            assert reports[0][key] == reports[1][key], key


def _assert_equal(one: Any, two: Any, name: str) -> None:
    if isinstance(one, dict):
        assert one.keys() == two.keys(), name
        for key in one:
            _assert_equal(one[key], two[key], f"{name}.{key}")
    elif isinstance(one, torch.Tensor):
        assert torch.equal(one, two), name
    else:
        assert one == two, name


def kill_at_random(
    scene: Path, folder: Path, gated: bool, number: signal.Signals, kills: int, seed: int, say: Callable[[str], None]
) -> dict[str, Any]:
    """Send a signal at random times to runs that save every fourth iteration, resume them, and compare the results.

    Returns:
        Counts: `kills` of living processes, `half_written` files left behind, and `runs` compared, all with equal
        results.
    """
    draw = random.Random(seed)
    whole = Run(scene, folder / "whole", gated, save_every=4)
    whole.finish()
    begun = time.perf_counter()
    # A second run, because the first one waited for the imports of the fork server.
    Run(scene, folder / "timed", gated, save_every=4).finish()
    seconds = time.perf_counter() - begun
    done = runs = half_written = stopped = 0
    while done < kills:
        run = Run(scene, folder / f"run{runs}", gated, save_every=4)
        for _ in range(4):
            process = run.start()
            time.sleep(draw.uniform(0.0, seconds))
            alive = process.is_alive()
            if alive:
                os.kill(process.pid or 0, number)
            code = run.expect(process, {0, -number, 128 + number, 130})
            done += alive and code != 0
            stopped += code > 0
            half_written += run.half_written()
        run.finish()
        assert_same(run.out, whole.out)
        shutil.rmtree(run.out)
        runs += 1
        say(f"{number.name}, {'gated' if gated else 'ungated'}: {done} of {kills}")
    return {"kills": done, "stopped_in_order": stopped, "half_written": half_written, "runs": runs}


def strike_every_file(scene: Path, folder: Path, gated: bool, faults: tuple[str, ...] = FAULTS) -> dict[str, int]:
    """Kill a run before and after it renames each file, and simulate a full disk there.

    Returns:
        Number of faults by kind. All runs had equal results after --resume.
    """
    whole = Run(scene, folder / "whole", gated, save_every=30)
    whole.finish()
    counts = {}
    for fault in faults:
        at = 0
        while True:
            at += 1
            run = Run(scene, folder / f"{fault.replace(' ', '_')}_{at}", gated, save_every=30)
            code = run.expect(run.start((fault, at)), {0, 2, -signal.SIGKILL})
            if code == 0 and "cannot be written" not in run.out.with_suffix(".log").read_text():
                break  # the run writes fewer files than `at`
            run.finish()
            assert_same(run.out, whole.out)
            shutil.rmtree(run.out)
        counts[fault] = at - 1
    return counts
