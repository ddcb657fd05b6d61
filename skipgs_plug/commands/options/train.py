"""Options of `skipgs-plug train`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Optional

import tyro

from skipgs_plug.commands.options.gate import GateOptions
from skipgs_plug.commands.options.parse import parse_as
from skipgs_plug.commands.options.session import SessionOptions
from skipgs_plug.trainer.config import REFERENCE_STEPS, TrainConfig


@dataclass
class Options(TrainConfig):
    """TrainConfig without folders and length of the run, which the command takes as SCENE, --out and --max-steps."""

    data_dir: tyro.conf.Suppress[str] = ""
    result_dir: tyro.conf.Suppress[str] = ""
    max_steps: tyro.conf.Suppress[int] = REFERENCE_STEPS
    schedule_steps: tyro.conf.Suppress[Optional[int]] = None


@dataclass
class Args:
    """Train a COLMAP, nerfstudio or Blender folder or a packed .npz by the 3DGS recipe.

    --share auto trains in fewer iterations, with larger, shrinking steps.
    """

    scene: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SCENE")]
    """Folder with sparse/0, transforms.json or transforms_train.json, packed .npz; with --sfm: photographs, a video."""
    out: str
    """Run folder to write."""
    sfm: bool = False
    """First reconstruct where the photographs were taken, like the command sfm, and keep the scene in OUT/scene."""
    max_steps: Optional[int] = None
    """Training iterations; default: 30,000, or with --resume as before. A larger number extends the run."""
    train: Annotated[Options, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Options)
    gate: bool = False
    """Attach the paper's gate. Any gate setting, such as --share auto, attaches a gate too."""
    gate_options: Annotated[GateOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=GateOptions)
    resume: bool = False
    """Continue from the last checkpoint in --out, or write the missing files of a finished run."""
    session: Annotated[SessionOptions, tyro.conf.arg(name="")] = dataclasses.field(default_factory=SessionOptions)


def parse(argv: list[str]) -> Args:
    return parse_as(Args, argv, "train")
