"""Options of `skipgs-plug bench`."""

from __future__ import annotations

import dataclasses
import shlex
from dataclasses import dataclass
from typing import Annotated, Optional

import tyro

from skipgs_plug.bench.choices import Clock
from skipgs_plug.commands.options.parse import Integers, OptionalWords, parse_as
from skipgs_plug.trainer.config import TrainConfig


@dataclass
class Options(TrainConfig):
    """TrainConfig with a schedule that a CPU finishes, without folders and seed."""

    data_dir: tyro.conf.Suppress[str] = ""
    result_dir: tyro.conf.Suppress[str] = ""
    seed: tyro.conf.Suppress[int] = 0
    max_steps: int = 3000
    """Training iterations."""


@dataclass
class Args:
    """Train under each policy, compare time and quality: refinement from one snapshot per seed, or whole runs.

    Evaluation, loading and compilation are outside the clock. A killed bench continues where it stopped when
    the same command is given again.
    """

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    """Folder with sparse/0, transforms.json or transforms_train.json, or packed .npz."""
    out: str = "skipgs_bench"
    """Folder for table, plots and runs."""
    seeds: Integers = (0, 1, 2)
    """Seeds of training; each densifies once."""
    whole: bool = False
    """Train from the first iteration under each policy, instead of refining one densified snapshot per seed."""
    policies: OptionalWords = None
    """What to compare, all unless given; controls copy rate, time or size of others."""
    train: Annotated[Options, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Options)
    tensorboard: bool = False
    """Log gsplat's scalars and the gate's counters of every run to OUT/tb; the clock stands meanwhile."""
    clock: Optional[Clock] = None
    """Seconds by the clock on the wall, or for which the processor worked for us: for a machine that others use too.
    Processor seconds unless given for whole runs on the CPU, else the wall's."""
    no_progress: bool = False
    """No progress bars."""
    command: tyro.conf.Suppress[str] = "skipgs-plug bench"
    """The command line, for bench.json."""


def parse(argv: list[str]) -> Args:
    return dataclasses.replace(parse_as(Args, argv, "bench"), command="skipgs-plug bench " + shlex.join(argv))
