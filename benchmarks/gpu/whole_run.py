"""Train gsplat, Inria's 3DGS and FastGS from first to last iteration, with and without share="auto", on this GPU.

    python -m benchmarks.gpu.whole_run SCENE CHECKOUTS --steps 30000 --out gpu_whole.json

Both projects' own scripts run unedited, each in a process of its own, one after the other, with their own settings. The
pictures of held-out views that they write are measured by one tool for both. Each finished run is stored at once, and
once more with the measures of its pictures, which take half a minute that the time limit does not include.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch

from benchmarks.pictures import find_pictures, measure_pictures
from skipgs_plug.files import write_aside

# The shorter runs first: a failure shows early.
MODES = {
    "auto": ["--share", "auto"],
    "auto_full_size": ["--share", "auto", "--half-size", "False"],
    "own": ["--no-gate"],
}


class Script(NamedTuple):
    """A project's training script.

    Attributes:
        folder: Name of its checkout in the folder of all checkouts.
        train: Command line, with placeholders {scene}, {out}, {n} (iterations) and {scale} (iterations / 30,000).
        render: Command line that writes pictures of held-out views, if training does not.
        seconds: Pattern of the training seconds that the script prints or stores, evaluation and loading left out. If
            the script has none, those of the gate's report count, from the first iteration to the last one.
        gaussians: Pattern of the number of Gaussians that it prints or stores.
    """

    folder: str
    train: str
    render: str | None
    seconds: str | None
    gaussians: str


def gsplat(strategy: str) -> Script:
    """Return gsplat's script, whose whole schedule is scaled to the iterations."""
    return Script(
        "gsplat",
        f"examples/simple_trainer.py {strategy} --data_dir {{scene}} --data_factor 1 --result_dir {{out}} "
        "--max_steps 30000 --eval_steps 30000 --save_steps 30000 --steps_scaler {scale} "
        "--disable_viewer --disable_video",
        None,
        r'"ellipse_time": ([\d.]+)',
        r'"num_GS": (\d+)',
    )


SCRIPTS = {
    "gsplat": gsplat("default"),
    "gsplat_mcmc": gsplat("mcmc"),
    # Inria's training script as DashGaussian keeps it, with the rasterizer and the loss kernels of that project.
    "inria": Script(
        "DashGaussian",
        "train.py -s {scene} -i images -r 1 --eval -m {out} --iterations {n} --save_iterations {n} "
        "--test_iterations -1 --disable_viewer",
        "render.py -m {out} --skip_train",
        None,
        r"GS Number: (\d+)",
    ),
    # The settings of FastGS' own train_base.sh for this scene.
    "fastgs": Script(
        "FastGS",
        "train.py -s {scene} -i images --eval -m {out} --iterations {n} --save_iterations {n} --test_iterations -1 "
        "--densification_interval 500 --optimizer_type default --highfeature_lr 0.02 --grad_abs_thresh 0.0006",
        "render.py -m {out} --skip_train",
        r"Training time: ([\d.]+)",
        r"Gaussian number: (\d+)",
    ),
}


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gpu.whole_run", description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, help="COLMAP folder")
    parser.add_argument("checkouts", type=Path, help="folder with the checkouts gsplat, DashGaussian and FastGS")
    parser.add_argument("--steps", type=int, default=30_000, help="iterations of the schedule")
    parser.add_argument("--only", nargs="+", choices=SCRIPTS, default=list(SCRIPTS), help="scripts to run")
    parser.add_argument("--modes", nargs="+", choices=MODES, default=["auto", "own"], help="with or without a gate")
    parser.add_argument("--seconds", type=float, default=3600.0, help="time limit of all runs")
    parser.add_argument("--lpips", choices=("alex", "vgg"), help="measure LPIPS too, with this backbone")
    parser.add_argument("--out", type=Path, default=Path("gpu_whole.json"), help="file to write")
    asked = parser.parse_args(argv)
    if not torch.cuda.is_available():
        print("torch sees no CUDA device here; this measures one.", file=sys.stderr)
        return 2
    end = time.monotonic() + asked.seconds
    result: dict[str, Any] = {
        "device": torch.cuda.get_device_name(),
        "torch": torch.__version__,
        "scene": asked.scene.name,
        "iterations": asked.steps,
        "runs": [],
    }
    failed = False
    for name in asked.only:
        for mode in asked.modes:
            left = end - time.monotonic()
            if left < 1.0:
                print(f"No time left for {name}, {mode}.", file=sys.stderr)
                failed = True
                continue
            folder = (asked.out.parent / f"{name}_{mode}").resolve()
            record = run(name, mode, folder, asked, left)
            result["runs"].append(record)
            store(result, asked.out)
            if "error" in record:
                failed = True
                continue
            record |= measure_pictures(find_pictures(folder), asked.lpips, "cuda")
            store(result, asked.out)
    print(table(result))
    return int(failed)


def store(result: dict[str, Any], out: Path) -> None:
    with write_aside(out) as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def run(name: str, mode: str, folder: Path, asked: argparse.Namespace, seconds: float) -> dict[str, Any]:
    """Run a script once, with output in `folder`.

    Returns:
        Its record without pictures, with `error` if it failed or took longer than `seconds`.
    """
    script = SCRIPTS[name]
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    filled = {"scene": asked.scene.resolve(), "out": folder, "n": asked.steps, "scale": asked.steps / 30_000}
    peak = folder / "peak.json"
    record: dict[str, Any] = {"script": name, "mode": mode}
    command = ["-P", "-m", "benchmarks.gpu.peak", str(peak), "skipgs_plug", "run", "auto", *MODES[mode], "--"]
    begun = time.monotonic()
    error = call([*command, *script.train.format(**filled).split()], asked.checkouts / script.folder, folder, seconds)
    record["wall_seconds"] = time.monotonic() - begun
    if error is None and script.render:
        error = call(script.render.format(**filled).split(), asked.checkouts / script.folder, folder, 120.0)
    if error is not None:
        return record | {"error": error}
    stored = [folder / "log.txt", *folder.glob("stats/train*"), *folder.glob("TRAIN_INFO")]
    written = "\n".join(path.read_text(errors="replace") for path in stored)
    found = next(folder.rglob("skipgs.json"), None)
    if found is None:
        return record | {"error": "it wrote no skipgs.json"}
    report = json.loads(found.read_text(encoding="utf-8"))
    seconds = re.findall(script.seconds, written)[-1] if script.seconds else report["t_total"]
    return record | {
        "train_seconds": float(seconds),
        "gaussians": int(re.findall(script.gaussians, written)[-1]),
        **json.loads(peak.read_text()),
        "report": report,
    }


def call(arguments: list[str], checkout: Path, folder: Path, seconds: float) -> str | None:
    """Run Python with `arguments`. Return None, or a sentence about the failure."""
    with (folder / "log.txt").open("a") as log:
        try:
            done = subprocess.run(
                [sys.executable, *arguments], cwd=checkout, stdout=log, stderr=subprocess.STDOUT, timeout=seconds
            )
        except subprocess.TimeoutExpired:
            return f"it took longer than {seconds:.0f} s"
    if done.returncode == 0:
        return None
    lines = (folder / "log.txt").read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else f"it ended with {done.returncode}"


def table(result: dict[str, Any]) -> str:
    """Return the records as a Markdown table."""
    lines = [
        f"{result['device']}, torch {result['torch']}, {result['scene']}, {result['iterations']:,} iterations",
        "",
        "| script | run | wall s | training s | iterations run | Gaussians | peak GiB | PSNR | SSIM | LPIPS |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for one in result["runs"]:
        if "error" in one:
            lines.append(f"| {one['script']} | {one['mode']} | {one['wall_seconds']:.1f} | {one['error']} |")
            continue
        lpips = next((one[key] for key in one if key.startswith("lpips")), None)
        cells = [
            one["script"],
            one["mode"],
            f"{one['wall_seconds']:.1f}",
            f"{one['train_seconds']:.1f}",
            f"{iterations_run(one, result['iterations']):,}",
            f"{one['gaussians']:,}",
            f"{one['peak_bytes'] / 2**30:.2f}",
            f"{one['psnr']:.2f}",
            f"{one['ssim']:.4f}",
            "" if lpips is None else f"{lpips:.4f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def iterations_run(record: dict[str, Any], iterations: int) -> int:
    """Return the number of iterations that ran."""
    report = record["report"] or {}
    growing = report.get("growing") or {}
    return iterations - report.get("iterations_skipped", 0) - growing.get("iterations_skipped", 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
