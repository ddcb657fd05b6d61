"""Runs gsplat's unmodified training script with and without a gate, in processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

CANDIDATES = ("gsplat/examples/simple_trainer.py", "../gsplat/examples/simple_trainer.py")
STEPS = 2000  # iterations, of which the second half is refinement


def find_script(given: str | None) -> Path | None:
    """Return the path of gsplat's simple_trainer.py: as given, from SKIPGS_SCRIPT, or in a checkout beside this one."""
    asked = given or os.environ.get("SKIPGS_SCRIPT")
    paths = [Path(asked)] if asked else [*map(Path, CANDIDATES), Path.home() / CANDIDATES[0]]
    return next((path for path in paths if path.is_file()), None)


def run_script(script: Path, scene: Path, seconds: float) -> dict[str, Any]:
    """Run gsplat's script twice: `off` and `gate` have `t_total`, `t_post`, `backwards_skipped`, or `error`.

    Args:
        script: Path of simple_trainer.py.
        scene: COLMAP folder.
        seconds: Time limit of both runs together.
    """
    found: dict[str, Any] = {"script": str(script)}
    for name, options in (("off", ["--threshold", "-0.999", "--warmup", "0"]), ("gate", ["--min-bwd-ratio", "0"])):
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "skipgs_plug", "run", "gsplat", *options, "--", str(script), "default"]
            command += ["--data_dir", str(scene), "--data_factor", "1", "--result_dir", folder, "--disable_viewer"]
            command += ["--max_steps", str(STEPS), "--strategy.refine_stop_iter", str(STEPS // 2)]
            try:
                done = subprocess.run(command, capture_output=True, text=True, timeout=max(seconds / 2, 1.0))
            except subprocess.TimeoutExpired:
                found[name] = {"error": f"it took longer than {seconds / 2:.0f} s"}
                continue
            written = next(Path(folder).rglob("skipgs.json"), None)
            if done.returncode or written is None:
                lines = done.stderr.strip().splitlines()
                found[name] = {"error": lines[-1] if lines else f"it ended with {done.returncode}"}
                continue
            report = json.loads(written.read_text())
            found[name] = {key: report[key] for key in ("t_total", "t_post", "backwards_skipped")}
    return found
