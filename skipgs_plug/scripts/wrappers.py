"""Explains command lines that start a training script by another program, which a gate cannot attach to."""

from __future__ import annotations

import re
from pathlib import Path

PYTHON = re.compile(r"python(\d+(\.\d+)?)?(\.exe)?")
SHELLS = {"bash", "sh", "zsh", "fish"}
LAUNCHERS = {"torchrun", "accelerate", "deepspeed", "fabric"}  # they start processes, each of which needs a gate


def wrapper_hint(name: str) -> str | None:
    """Return how to write a command that begins with this word; None if the word is no program that starts scripts."""
    word = Path(name)
    if PYTHON.fullmatch(word.name):
        return f"Leave out {name}: write after '--' what follows it, for example -- train.py -s data."
    if word.name in SHELLS or word.suffix == ".sh":
        return (
            f"{name} is not Python: write skipgs-plug run ADAPTER -- in place of python before train.py, in the shell "
            "script."
        )
    if word.name in LAUNCHERS:
        return (
            f"Every process needs a gate, so {name} must start skipgs-plug, and not the other way round: {name} ... "
            "-m skipgs_plug run ADAPTER -- train.py (docs/gate.md)."
        )
    return None
