"""The plot of `raster.py`."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def plot(results: dict[str, Any], path: Path) -> None:
    """Plot all parts in `results`, the content of raster.json, to a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(12, 9), layout="constrained")
    scenes, against, scaling, optimizations = axes.flat
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    if "scenes" in results:
        rows = results["scenes"]["rows"]
        counts = sorted({row["threads"] for row in rows})
        labels = [f"{r['kind']} {r['gaussians']:,} {r['size']}" for r in rows if r["threads"] == counts[0]]
        peers = [row["peer_ms"] for row in rows if row["threads"] == 1]
        bars = {"OpenSplat, 1 thread": peers}
        bars |= {f"ours, {c} thread{'s' * (c > 1)}": [r["ms"] for r in rows if r["threads"] == c] for c in counts}
        for shift, (label, values) in enumerate(bars.items()):
            scenes.barh([i + 0.27 * (shift - 1) for i in range(len(labels))], values, 0.25, label=label)
        scenes.set(xscale="log", xlabel="forward + backward (ms)", yticks=range(len(labels)), yticklabels=labels)
        scenes.invert_yaxis()
        scenes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(bars), fontsize="small")
    for name in ("gaussians", "pixels", "sh_terms"):
        if name in results:
            rows, exponent = results[name]["rows"]["points"], results[name]["rows"]["exponents"]["time"]["fitted"]
            label = f"{name.replace('_', ' ')}, exponent {exponent:.2f}"
            against.plot([row["x"] for row in rows], [row["ms"] for row in rows], "o-", label=label)
    against.set(xscale="log", yscale="log", xlabel="Gaussians, pixels or SH terms", ylabel="forward + backward (ms)")
    if against.lines:
        against.legend()
    if "threads" in results:
        rows = results["threads"]["rows"]
        counts = [row["threads"] for row in rows]
        scaling.plot(counts, [row["speedup"] for row in rows], "o-", label="measured")
        scaling.plot(counts, counts, "--", color="gray", label="ideal")
        scaling.set(xlabel="threads", ylabel="times faster than one thread", xticks=counts)
        scaling.legend()
    if "optimizations" in results:
        rows = results["optimizations"]["rows"]
        # Each row alternated with a baseline of its own, so only shares are comparable.
        saved = [100 * row["saved"] for row in rows]
        errors = [100 * row["saved_error"] for row in rows]
        optimizations.barh([row["optimization"] for row in rows], saved, xerr=errors, ecolor="gray")
        optimizations.set(xlabel="time saved by the optimization (%), and its standard error")
    figure.savefig(path, dpi=120)
