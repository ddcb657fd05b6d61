"""Measure the gate on this GPU: `python -m benchmarks.gpu SCENE`, from the root of a checkout.

Installs nothing, ends within eight minutes, writes one JSON file and prints one table: how often the host waits for the
device, peak memory overall and over the first skip, seconds of refinement and in all, and PSNR. It measures the trainer
of this package on gsplat, and gsplat's own simple_trainer.py if a checkout is found (`--script`, SKIPGS_SCRIPT, or
`gsplat` beside this folder).
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import torch

from benchmarks.gpu.machine import CudaMachine
from benchmarks.gpu.measure import Deadline, compare
from benchmarks.gpu.script import find_script, run_script
from skipgs_plug.trainer import InputError, load_scene
from skipgs_plug.trainer.backend import resolve_backend

# Time limit of all measurements: half a minute less than eight minutes, for work that cannot be stopped.
SECONDS = 450.0
SCRIPT_SHARE = 0.35  # share of the time for gsplat's script, if there is one


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu", description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="COLMAP, nerfstudio or Blender folder, or packed .npz")
    parser.add_argument("--script", help="gsplat's examples/simple_trainer.py")
    parser.add_argument("--out", type=Path, default=Path("gpu.json"), help="file to write")
    asked = parser.parse_args(argv)
    deadline = Deadline(SECONDS)
    try:
        if not torch.cuda.is_available():
            raise InputError("torch sees no CUDA device here; this measures one.")
        scene, backend = load_scene(asked.scene), resolve_backend("gsplat")
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    machine = CudaMachine()
    script = find_script(asked.script) if asked.scene.is_dir() else None
    own = Deadline(deadline.left * (1.0 - SCRIPT_SHARE if script else 1.0))
    result: dict[str, Any] = {"device": machine.name, "torch": torch.__version__, "scene": str(asked.scene)}
    result["trainer"] = compare(scene, backend, machine, own)
    result["script"] = None if script is None else run_script(script, asked.scene, deadline.left)
    asked.out.write_text(json.dumps(result, indent=1) + "\n")
    print(table(result))
    return 0


def table(result: dict[str, Any]) -> str:
    """Return the figures as a Markdown table, and the names of missing runs."""
    trainer = result["trainer"]
    lines = [
        f"{result['device']}, {trainer['schedule']} iterations, {trainer['num_GS']} Gaussians",
        "",
        "| run | waits per iteration | peak | over the first skip | T_post | T_total | PSNR |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, run in trainer["runs"].items():
        skip = "-" if run["peak_bytes_first_skip"] is None else f"{run['peak_bytes_first_skip'] / 2**20:.0f} MiB"
        lines.append(
            f"| {name} | {run['waits_per_iteration']:.2f} | {run['peak_bytes'] / 2**20:.0f} MiB | {skip} | "
            f"{run['t_post']:.1f} s | {run['t_total']:.1f} s | {run['psnr']:.2f} |"
        )
    lines += [f"Left out, for want of time: {name}" for name in trainer["left_out"]]
    script = result["script"]
    if script is None:
        lines.append("No simple_trainer.py of gsplat was found; give --script.")
        return "\n".join(lines)
    for name in ("off", "gate"):
        run = script[name]
        said = run["error"] if "error" in run else f"T_post {run['t_post']:.1f} s, T_total {run['t_total']:.1f} s"
        lines.append(f"{Path(script['script']).name}, {name}: {said}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
