"""Table of the recorded runs of other projects' scripts: own run and run with the gate, by scene and script.

python benchmarks/script_table.py benchmarks/results/scripts/runs.json > benchmarks/results/scripts/table.md
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import fmean
from typing import Any

Run = dict[str, Any]
Pair = dict[str, Run]  # runs of one script from the same points, by mode

HEAD = (
    "| script | iterations | run with auto | s | s with auto | % of own | Gaussians | with auto "
    "| PSNR (SSIM) | with auto | difference dB |"
)


def table(runs: list[Run]) -> str:
    """Return a Markdown table with one row for each scene, script and schedule, in the order of the records.

    A script that ran from several draws of the initial points has means over the draws, and each draw's difference in
    brackets. Seconds from a core that other programs used have a star. They are compared only with each other.
    """
    rows: dict[tuple[str, str, int], dict[int, Pair]] = {}
    for run in runs:
        draws = rows.setdefault((run["scene"], run["script"], run["iterations"]), {})
        draws.setdefault(run["points_seed"], {})[run["mode"]] = run
    lines: list[str] = []
    shown: list[Pair] = []
    for scene in dict.fromkeys(key[0] for key in rows):
        lines += [f"{scene}:", "", HEAD, "|---" + "|---:" * 10 + "|"]
        for key, draws in rows.items():
            pairs = [pair for _, pair in sorted(draws.items()) if pair.keys() >= {"own", "auto"}]
            if key[0] == scene and pairs:
                lines.append(row(key[1], key[2], pairs))
                shown += pairs
        lines.append("")
    return "\n".join([*lines, *notes(shown)])


def notes(pairs: list[Pair]) -> list[str]:
    """Return the sentences below the table, as lines."""
    alike = sum(pair["own"]["package_commit"] == pair["auto"]["package_commit"] for pair in pairs)
    return [
        "Seconds with a star are from a core that other programs used, too, which makes them too high. The percentage",
        "compares only pairs whose runs are alike in this.",
        "",
        f"In {alike} of {len(pairs)} pairs both runs are from one version of this package",
        "(`runs.json` has the commits). Rounding differs between versions, which alone moves a run by 0.0 to 0.5 dB.",
    ]


def row(script: str, iterations: int, pairs: list[Pair]) -> str:
    """Return one row of the table."""

    def both(cell: Callable[[list[Run]], str]) -> tuple[str, str]:
        return cell([pair["own"] for pair in pairs]), cell([pair["auto"] for pair in pairs])

    alike = [pair for pair in pairs if pair["own"].get("busy_core") == pair["auto"].get("busy_core")]
    share = sum(p["auto"]["seconds"] for p in alike) / sum(p["own"]["seconds"] for p in alike) if alike else None
    cells = [
        script,
        f"{iterations:,}",
        f"{mean([pair['auto'] for pair in pairs], 'iterations_run'):,.0f}",
        *both(seconds),
        "" if share is None else f"{100 * share:.0f}",
        *both(gaussians),
        *both(quality),
        difference([pair["auto"]["psnr"] - pair["own"]["psnr"] for pair in pairs]),
    ]
    return f"| {' | '.join(cells)} |"


def mean(runs: list[Run], name: str) -> float:
    return fmean(run[name] for run in runs)


def seconds(runs: list[Run]) -> str:
    """Return the mean of the seconds, with a star if other programs used the core, which makes them too high."""
    return f"{mean(runs, 'seconds'):.0f}{'*' if any(run.get('busy_core') for run in runs) else ''}"


def gaussians(runs: list[Run]) -> str:
    return "" if any(run["gaussians"] is None for run in runs) else f"{mean(runs, 'gaussians'):,.0f}"


def quality(runs: list[Run]) -> str:
    return f"{mean(runs, 'psnr'):.2f} ({mean(runs, 'ssim'):.4f})"


def difference(each: list[float]) -> str:
    draws = f" ({', '.join(f'{one:+.2f}' for one in each)})" if len(each) > 1 else ""
    return f"{fmean(each):+.2f}{draws}"


if __name__ == "__main__":
    print(table(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))["runs"]))
