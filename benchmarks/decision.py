"""Time of one decision: SkipPolicy, an empty function call, and the authors' controller if a checkout is given.

python benchmarks/decision.py [--authors PATH_TO_THEIR_CHECKOUT] [--out FILE]
"""

from __future__ import annotations

import argparse
import os
import platform
import random
import sys
import time
from collections.abc import Callable
from pathlib import Path

from skipgs_plug.core.policy import SkipPolicy
from skipgs_plug.trainer.files import write_json

# Views of the stream, decisions in each pass, and passes. The fastest pass counts.
VIEWS, STEPS, REPEATS = 100, 20_000, 15

Decide = Callable[[str, float, int], object]


def loss_stream() -> list[tuple[str, float, int]]:
    """Return epochs of shuffled views whose losses fall slowly, with noise."""
    draw = random.Random(0)
    base = [draw.uniform(0.02, 0.3) for _ in range(VIEWS)]
    rows: list[tuple[str, float, int]] = []
    while len(rows) < STEPS:
        for view in draw.sample(range(VIEWS), VIEWS):
            decay = 0.8 + 0.2 * 0.9998 ** len(rows)
            rows.append((f"images/{view:04d}.png", base[view] * decay * draw.gauss(1.0, 0.05), len(rows)))
    return rows[:STEPS]


def microseconds(make: Callable[[], Decide], rows: list[tuple[str, float, int]]) -> float:
    """Return the time of a call: the best of REPEATS passes over the stream."""
    best = float("inf")
    for _ in range(REPEATS):
        decide = make()
        start = time.perf_counter()
        for view, loss, step in rows:
            decide(view, loss, step)
        best = min(best, time.perf_counter() - start)
    return 1e6 * best / len(rows)


def empty(view: str, loss: float, step: int) -> None:
    """Do nothing. Its time is the lower limit of this measurement."""


def authors_controller(checkout: Path) -> Callable[[], Decide]:
    """Import the authors' controller from a checkout of their repository."""
    sys.path.insert(0, str(checkout))
    from skipgs import SkipController  # type: ignore[import-not-found]

    return lambda: SkipController(start_iter=0).decide


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--authors", type=Path, help="checkout of skill-diver/SkipGS")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "decision.json")
    args = parser.parse_args()

    candidates: dict[str, Callable[[], Decide]] = {
        "empty function call": lambda: empty,
        "SkipPolicy.decide": lambda: SkipPolicy(start_iter=0).decide,
    }
    if args.authors:
        candidates["authors' controller"] = authors_controller(args.authors)
    rows = loss_stream()
    times = {name: microseconds(make, rows) for name, make in candidates.items()}

    print(f"one decision, best of {REPEATS} x {STEPS} calls, {VIEWS} views, Python {platform.python_version()}")
    for name, cost in times.items():
        print(f"  {name:22s} {cost:6.3f} us")
    result = {
        "microseconds": times,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "cpus": os.cpu_count(),
        "calls": STEPS,
        "repeats": REPEATS,
    }
    write_json(args.out, result)


if __name__ == "__main__":
    main()
