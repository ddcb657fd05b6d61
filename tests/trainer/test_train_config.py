"""Option values that no run survives are refused before it begins."""

from __future__ import annotations

import dataclasses

import pytest

from skipgs_plug.trainer import InputError, Scene, TrainConfig
from skipgs_plug.trainer.config import INTEGERS, NUMBERS
from skipgs_plug.trainer.loop import Trainer
from skipgs_plug.trainer.ply import read_ply


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("init_opa", 2.0),
        ("init_opa", 0.0),
        ("init_opa", 1.0),
        ("init_scale", 0.0),
        ("init_scale", -1.0),
        ("means_lr", -1e-4),
        ("sh0_lr", float("nan")),
        ("near_plane", 0.0),
        ("near_plane", 1e20),
        ("max_steps", 0),
        ("max_steps", 10.0),
        ("init_num_pts", 3),
        ("sh_degree", 4),
        ("refine_every", True),
        ("ssim_lambda", 1.5),
        ("init_opa", "0.1"),
    ],
)
def test_out_of_range(name: str, value: object) -> None:
    with pytest.raises(InputError, match=name):
        TrainConfig(**{name: value})


def test_every_number_has_a_range() -> None:
    kinds = {f.name: f.type.removeprefix("Optional[").removesuffix("]") for f in dataclasses.fields(TrainConfig)}
    numbers = {name for name, kind in kinds.items() if kind in ("int", "float")}
    assert numbers == set(INTEGERS) | set(NUMBERS)


@pytest.mark.parametrize("edge", [0, 1])
def test_the_ends_of_the_ranges_export_what_our_reader_takes(tiny_scene: Scene, tmp_path, edge: int) -> None:
    config = TrainConfig(init_opa=NUMBERS["init_opa"][edge], init_scale=NUMBERS["init_scale"][edge], max_steps=2)
    trainer = Trainer(config, tiny_scene)
    trainer.train(progress=False)
    trainer.export_ply(tmp_path / "model.ply")
    assert len(read_ply(tmp_path / "model.ply")["means"]) == len(tiny_scene.points)
