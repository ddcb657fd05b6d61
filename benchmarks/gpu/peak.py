"""Runs a module as a program and writes the GPU's peak memory: `python -m benchmarks.gpu.peak FILE MODULE ...`."""

import json
import runpy
import sys
from pathlib import Path

import torch


def main(file: str, module: str, *arguments: str) -> None:
    """Run `module` with `arguments` and write `peak_bytes`, the most memory that PyTorch had allocated at once."""
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        peak = torch.cuda.max_memory_allocated() if torch.cuda.is_initialized() else None
        Path(file).write_text(json.dumps({"peak_bytes": peak}))


if __name__ == "__main__":
    main(*sys.argv[1:])
