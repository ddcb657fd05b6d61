"""A short run on real photographs (LLFF fern, 252x189): gated against ungated, resume, PLY."""

import copy
from pathlib import Path

import pytest
import torch
from plyfile import PlyData

from skipgs_plug import SkipGate
from skipgs_plug.trainer import Scene, TrainConfig, Trainer, load_scene

STEPS = 900


@pytest.fixture(scope="module")
def fern(shared: Path) -> Scene:
    return load_scene(shared / "data" / "fern", data_factor=2)


@pytest.fixture(scope="module")
def densified(fern: Scene) -> tuple[Trainer, dict]:
    trainer = Trainer(TrainConfig(max_steps=STEPS), fern)
    trainer.train(until=trainer.refine_stop_iter, progress=False)
    return trainer, trainer.snapshot()


def refine(densified: tuple[Trainer, dict], gated: bool) -> tuple[dict, SkipGate, dict]:
    trainer, snapshot = densified
    trainer.restore(copy.deepcopy(snapshot))
    with SkipGate(trainer, enabled=gated) as gate:
        trainer.train(progress=False)
    return trainer.evaluate(), gate, {name: p.detach().clone() for name, p in trainer.splats.items()}


def test_gated_refinement_skips_and_keeps_quality(densified: tuple[Trainer, dict]) -> None:
    ungated, _, _ = refine(densified, gated=False)
    gated, gate, _ = refine(densified, gated=True)
    stats = gate.stats()
    assert stats["gated_iterations"] == STEPS - densified[0].refine_stop_iter
    assert stats["backwards_run"] + stats["backwards_skipped"] == stats["gated_iterations"]
    assert stats["backwards_skipped"] > 0.15 * stats["gated_iterations"]
    assert ungated["psnr"] > 17
    assert abs(ungated["psnr"] - gated["psnr"]) < 0.3


def test_interrupted_and_resumed_equals_uninterrupted(densified: tuple[Trainer, dict], tmp_path: Path) -> None:
    _, whole_gate, whole = refine(densified, gated=True)
    trainer, snapshot = densified
    trainer.restore(copy.deepcopy(snapshot))
    with SkipGate(trainer):
        trainer.train(until=STEPS - 150, progress=False)
        trainer.save_checkpoint(tmp_path / "interrupted.pt")

    resumed = Trainer(trainer.config, trainer.scene)
    with SkipGate(resumed) as gate:
        resumed.load_checkpoint(tmp_path / "interrupted.pt")
        resumed.train(progress=False)
    for name, parameter in resumed.splats.items():
        assert torch.equal(parameter, whole[name]), name
    assert gate.stats()["backwards_skipped"] == whole_gate.stats()["backwards_skipped"]
    assert gate.view_table() == whole_gate.view_table()


def test_ply_is_readable_by_another_reader(densified: tuple[Trainer, dict], tmp_path: Path) -> None:
    trainer, _ = densified
    trainer.export_ply(tmp_path / "fern.ply")
    vertex = PlyData.read(tmp_path / "fern.ply")["vertex"]
    assert len(vertex.properties) == 62
    assert vertex.count == len(trainer.splats["means"])
    torch.testing.assert_close(torch.tensor(vertex["opacity"].copy()), trainer.splats["opacities"].detach())
