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


def parse(argv: list[str]) -> Args:
    """Return the options.

    Raises:
        InputError: A length or the number of seconds is out of its range. `Args` does not check them, since tyro would
            answer with its own words.
    """
    args = parse_as(Args, argv, "estimate")
    if not args.steps or not all(1 <= steps <= LONGEST for steps in args.steps):
        raise InputError(f"--steps {' '.join(map(str, args.steps))}: give lengths of 1 to {LONGEST:,} iterations.")
    if not (math.isfinite(args.seconds) and args.seconds > 0):
        raise InputError(f"--seconds {args.seconds:g} is not a positive number; give seconds, such as 30.")
    return args
