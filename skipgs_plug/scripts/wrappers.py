"""Explains command lines that start a training script by another program, which a gate cannot attach to."""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path

PYTHON = re.compile(r"python(\d+(\.\d+)?)?(\.exe)?")
SHELLS = {"bash", "sh", "zsh", "fish"}
LAUNCHERS = {"torchrun", "accelerate", "deepspeed", "fabric"}  # they start processes, each of which needs a gate
VARIABLE = re.compile(r"[A-Za-z_]\w*=")
BEGINNING = 512  # bytes of a program that name its interpreter
LONG_PATH = b"'''exec'"  # how pip begins the second line where the interpreter's path is too long for the first one


def wrapper_hint(name: str) -> str | None:
    """Return how to write a command that begins with this word; None if the word is no program that starts scripts."""
    word = Path(name)
    if name.startswith("-"):
        return (
            f"{name} is no script: the first word after '--' is the training script; options of skipgs-plug go before "
            "'--', and those of Python follow python, as in python -u -m skipgs_plug run ADAPTER -- train.py."
        )
    if VARIABLE.match(name) and not os.path.isfile(name):
        return f"{name} sets a variable of the environment: write it before skipgs-plug, not after '--'."
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


def program_hint(name: str) -> str | None:
    """Return how to write a command that begins with this program; None if the word is no program on this machine."""
    program = shutil.which(name)
    if program is None:
        return None
    try:
        with open(program, "rb") as file:
            beginning = file.read(BEGINNING)
    except OSError:  # it may be executed, but not read
        beginning = b""
    first, second, *_ = [*beginning.splitlines(), b"", b""]
    line = second if second.startswith(LONG_PATH) else first if first.startswith(b"#!") else b""
    interpreter = next((word for word in re.split(rb"[\s'\"!]+", line) if b"python" in word), None)
    if interpreter is not None and interpreter in (os.fsencode(sys.executable), b"python", b"python3"):
        return f"{name} is a Python script on the PATH: give its path, {program}."
    if interpreter is not None:
        return (
            f"{program} belongs to another Python than the one that runs skipgs-plug: install skipgs-plug there too, "
            "and run it from there."
        )
    return (
        f"{name} is a program, and no Python script: let it start skipgs-plug, as in {name} ... skipgs-plug run "
        "ADAPTER -- train.py."
    )
