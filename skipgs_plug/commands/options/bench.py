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
    """TrainConfig without folders and seed, and with a schedule that is short enough for a CPU."""

    data_dir: tyro.conf.Suppress[str] = ""
    result_dir: tyro.conf.Suppress[str] = ""
    seed: tyro.conf.Suppress[int] = 0
    max_steps: int = 3000
    """Training iterations."""
    clear_depth: float = 0.0
    """Densification prunes Gaussians nearer to a camera than this share of the depth of the nearest points in its view:
    they are haze. A bench compares with the plain recipe, which prunes none (0)."""


@dataclass
class Args:
    """Train under each policy and compare time and quality: refinement from one snapshot per seed, or whole runs.

    Evaluation, loading and compilation do not count as time. The same command continues a bench that was killed.
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
    """Policies to compare; default: all. Controls copy the rate, time or size of other policies."""
    train: Annotated[Options, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Options)
    tensorboard: bool = False
    """Log gsplat's scalars and the gate's counters of every run to OUT/tb, outside the measured time."""
    clock: Optional[Clock] = None
    """Wall time, or processor seconds of this process, which suit a machine that others use too.
    Default: processor seconds for whole runs on the CPU, else wall time."""
    no_progress: bool = False
    """No progress bars."""
    command: tyro.conf.Suppress[str] = "skipgs-plug bench"
    """The command line, for bench.json."""


def parse(argv: list[str]) -> Args:
    return dataclasses.replace(parse_as(Args, argv, "bench"), command="skipgs-plug bench " + shlex.join(argv))
