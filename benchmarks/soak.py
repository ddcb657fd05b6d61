"""Runs the package through failures: kills, full disks, broken process groups, mutated files, a million decisions.

Takes a quarter of an hour or more.

python -m benchmarks.soak [--kills N] [--files N] [--seed N] [--out FILE]

Draws a new seed unless one is given. Stops with an error at the first run that does not end as it should.
"""

from __future__ import annotations

import argparse
import random
import shlex
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.common import provenance
from benchmarks.soak_files import run as mutate_files
from benchmarks.soak_ranks import TIME_OUT, train_together
from benchmarks.soak_runs import kill_at_random, make_tiny_scene, strike_every_file
from skipgs_plug import SkipGate
from skipgs_plug.trainer.files import write_json

# Decisions in all, views that they are about, and parts whose time and memory are recorded.
DECISIONS, VIEWS, PARTS = 1_000_000, 10_000, 10


class Backward:
    """A loss whose backward pass does nothing."""

    def backward(self) -> None: ...


def resident() -> float:
    """Return the resident memory of this process in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def decide_often(seed: int) -> dict[str, Any]:
    """Take a million decisions about 10,000 views with a whole gate, and return time and memory of each tenth."""
    draw = random.Random(seed)
    gate, loss, step = SkipGate(start_iter=0), Backward(), 0
    base = [draw.uniform(0.02, 0.3) for _ in range(VIEWS)]
    microseconds, megabytes = [], []
    for _ in range(PARTS):
        begun = time.perf_counter()
        for _ in range(DECISIONS // PARTS):
            view = draw.randrange(VIEWS)
            gate.backward(loss, view=view, step=step, signal=base[view] * draw.uniform(0.9, 1.1))
            step += 1
        microseconds.append(1e6 * (time.perf_counter() - begun) / (DECISIONS // PARTS))
        megabytes.append(resident())
    return {
        "decisions": DECISIONS,
        "views": VIEWS,
        "microseconds_per_decision": microseconds,
        "resident_mb": megabytes,
        "skipped": gate.stats()["backwards_skipped"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="of each signal, half of them in gated runs")
    parser.add_argument("--files", type=int, default=20_000, help="mutated scene, image and PLY files")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "soak.json")
    args = parser.parse_args()
    seed = random.randrange(10**6) if args.seed is None else args.seed
    result: dict[str, Any] = {
        **provenance(),
        "command": shlex.join(["python", "-m", "benchmarks.soak", *sys.argv[1:]]),
        "seed": seed,
    }
    begun = time.perf_counter()

    def record(section: str, name: str, measure: Callable[[], Any]) -> None:
        result.setdefault(section, {})[name] = measure()
        result["minutes"] = (time.perf_counter() - begun) / 60
        write_json(args.out, result)
        print(f"{section}, {name}: {result[section][name]}", flush=True)

    with tempfile.TemporaryDirectory(prefix="soak_") as temporary:
        folder = Path(temporary)
        scene = make_tiny_scene(folder)
        record("decisions", "gate", lambda: decide_often(seed))
        for size in (2, 4):
            for kind in ("disagree", "lag", "hang", "die"):
                group = folder / f"{kind}{size}"
                record("ranks", f"{size} {kind}", lambda: train_together(group, size, kind))  # noqa: B023
        result["ranks"]["time_out"] = TIME_OUT
        record("mutated files", "outcomes", lambda: mutate_files(args.files, seed))
        for gated in (True, False):
            name = "gated" if gated else "ungated"
            for number in (signal.SIGKILL, signal.SIGTERM):
                runs = folder / f"{name}_{number.name}"
                runs.mkdir()
                more = (gated, number, (args.kills + 1) // 2, seed, lambda text: None)
                record(number.name, name, lambda: kill_at_random(scene, runs, *more))  # noqa: B023
            runs = folder / f"{name}_files"
            runs.mkdir()
            record("files", name, lambda: strike_every_file(scene, runs, gated))  # noqa: B023


if __name__ == "__main__":
    main()
