"""Options of `skipgs-plug estimate`."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated

import tyro

from skipgs_plug.commands.options.parse import Integers, parse_as
from skipgs_plug.commands.options.train import Options
from skipgs_plug.trainer.errors import InputError

LONGEST = 10_000_000  # iterations of a run, at most: larger numbers are typing errors


@dataclass
class Args:
    """Train for half a minute and predict how long whole runs take here, with and without --share auto.

    Nothing is written. The settings of training are the same as for `train`; give the settings of the planned run.
    """

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    """Folder with sparse/0, transforms.json or transforms_train.json, or packed .npz."""
    steps: Integers = (7000, 30_000)
    """Lengths of runs, in iterations."""
    seconds: float = 30.0
    """Seconds of training to measure; more give a better estimate."""
    train: Annotated[Options, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Options)
    no_progress: bool = False
    """No progress bar."""

    def __post_init__(self) -> None:
        if not self.steps or not all(1 <= steps <= LONGEST for steps in self.steps):
            raise InputError(f"--steps {' '.join(map(str, self.steps))}: give lengths of 1 to {LONGEST:,} iterations.")
        if not (math.isfinite(self.seconds) and self.seconds > 0):
            raise InputError(f"--seconds {self.seconds:g} is not a positive number; give seconds, such as 30.")


def parse(argv: list[str]) -> Args:
    return parse_as(Args, argv, "estimate")
