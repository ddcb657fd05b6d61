"""Options of `skipgs-plug run`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from skipgs_plug.commands.options.gate import GateOptions
from skipgs_plug.commands.options.parse import Words, parse_as
from skipgs_plug.trainer.errors import InputError


def split(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Separate the options of `run` from the script's command line."""
    if "--" not in argv:
        return list(argv), []
    at = list(argv).index("--")
    return list(argv[:at]), list(argv[at + 1 :])


@dataclass
class Args:
    """Run a training script of another project, unedited and gated.

    Write the words that follow `python` after `--`: skipgs-plug run fastgs -- train.py -s data/garden.
    Exit code, output and files are the script's own. skipgs.json is added to its output folder.
    """

    adapter: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ADAPTER -- SCRIPT ...")]
    """Name of the trainer, such as inria, fastgs or taming, or auto to recognise its script."""
    gate_options: Annotated[GateOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=GateOptions)
    resume_gate: str = "auto"
    """State to resume the gate from: auto (beside the checkpoint that the script loads), off, or a path."""
    no_gate: bool = False
    """Change nothing in training; skipgs.json then holds the seconds of the trainer's own run."""
    cpu: bool = False
    """Run on the CPU: CUDA requests are redirected, and CUDA modules are served by the CPU rasterizer."""
    command: tyro.conf.Suppress[Words] = ()
    """The command line after `--`."""


def parse(argv: list[str]) -> Args:
    ours, command = split(argv)
    script = next((word for word in ours if word.endswith(".py")), None)
    if script is not None and "--" not in argv:
        raise InputError(f"Write '--' before the script: skipgs-plug run {ours[0]} ... -- {script} ...")
    return dataclasses.replace(parse_as(Args, ours, "run"), command=tuple(command))
