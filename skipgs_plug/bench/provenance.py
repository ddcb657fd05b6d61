"""Provenance of the numbers: machine, versions, commit, scene, images, split."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

import skipgs_plug
from skipgs_plug.fallback_raster import get_num_threads
from skipgs_plug.trainer import Scene, TrainConfig
from skipgs_plug.trainer.backend import Backend
from skipgs_plug.trainer.near_plane import near_plane

MEASURING = ("skipgs_plug", "benchmarks/*.py")  # code that the figures depend on
PACKAGES = ("torch", "warp-lang", "gsplat", "numpy", "torchmetrics")


def machine(backend: Backend) -> dict[str, Any]:
    """Return the facts that determine speed: processor, cores, threads, memory, GPU, backend."""
    return {
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "threads": get_num_threads() if backend.name == "warp" else torch.get_num_threads(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30)
        if hasattr(os, "sysconf")
        else None,
        "gpu": torch.cuda.get_device_name() if backend.device.type == "cuda" else None,
        "system": f"{platform.system()} {platform.machine()}",
        "backend": backend.name,
    }


def cpu_name() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def versions() -> dict[str, str]:
    """Return the versions of Python, of this package, and of the packages that it computes with."""
    found = {"python": platform.python_version()}
    for name in ("skipgs_plug", *PACKAGES):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def commit() -> str | None:
    """Return the commit of this package's checkout, with "+" if its code differs; None without a checkout."""
    root = Path(skipgs_plug.__file__).parents[1]
    if not (root / ".git").exists():
        return None
    try:
        head = git(root, "rev-parse", "--short=12", "HEAD")
        changed = git(root, "status", "--porcelain", "--untracked-files=no", "--", *MEASURING)
    except (OSError, subprocess.CalledProcessError):
        return None
    return head + ("+" if changed else "")


def git(root: Path, *arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def scene_facts(scene: Scene, config: TrainConfig) -> dict[str, Any]:
    """Return facts about a scene with which readers can compare numbers: images, their source, factor, split."""
    sizes = sorted({(view.width, view.height) for view in scene.train + scene.test})
    return {
        "name": scene.name,
        "image_sizes": [f"{width}x{height}" for width, height in sizes],
        "images": image_source(Path(config.data_dir).expanduser(), config.data_factor),
        "data_factor": config.data_factor,
        "split": split_rule(Path(config.data_dir).expanduser(), config.test_every),
        "train_views": len(scene.train),
        "test_views": len(scene.test),
        "points": len(scene.points),
        "near_plane": scene.frame.dataset_length(near_plane(config, scene)),
    }


def image_source(path: Path, factor: int) -> str:
    if path.is_file():
        return "as packed"
    if factor == 1:
        return "as found"
    if (path / f"images_{factor}").is_dir():
        return f"folder images_{factor}"
    return f"resized in memory by {factor}"


def split_rule(path: Path, test_every: int) -> str:
    if path.is_file():
        return "as packed"
    if not (path / "sparse").is_dir() and (path / "transforms_test.json").is_file():
        return "transforms_test.json"
    return f"held out: by name, index % {test_every} == 0"
