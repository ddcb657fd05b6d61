"""A short run on real photographs (LLFF fern, 252x189): gated against ungated, resume, PLY."""

from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from plyfile import PlyData
from torch import Tensor

from skipgs_plug import SkipGate
from skipgs_plug.trainer import Scene, TrainConfig, Trainer, load_scene

# Refinement must be long enough for losses to level off: with 900 iterations the gate costs 0.6 dB. The higher
# threshold keeps the model near 19,000 Gaussians, which suits images this small. Measured for seeds 42, 0 and 1:
#   before refinement  28.04  28.18  28.26 dB
#   ungated            28.88  28.87  29.01
#   gated              28.59  28.69  28.83, with 44, 38 and 36 % of the backwards skipped
# Other rounding (another processor) moves an end by about 0.1 dB, so seed 42 is too near the bound of 0.3.
CONFIG = TrainConfig(max_steps=3000, grow_grad2d=0.001, seed=0)


class Refined(NamedTuple):
    """One refinement from the snapshot."""

    metrics: dict[str, Any]
    gate: SkipGate
    splats: dict[str, Tensor]


@pytest.fixture(scope="module")
def fern(shared: Path) -> Scene:
    return load_scene(shared / "data" / "fern", data_factor=2)


@pytest.fixture(scope="module")
def densified(fern: Scene) -> tuple[Trainer, dict[str, Any]]:
    trainer = Trainer(CONFIG, fern)
    trainer.train(until=trainer.refine_stop_iter, progress=False)
    return trainer, trainer.snapshot()


@pytest.fixture(scope="module")
def gated(densified: tuple[Trainer, dict[str, Any]]) -> Refined:
    return refine(densified, enabled=True)


def refine(densified: tuple[Trainer, dict[str, Any]], enabled: bool) -> Refined:
    trainer, snapshot = densified
    trainer.restore(snapshot)
    with SkipGate(trainer, enabled=enabled) as gate:
        trainer.train(progress=False)
    splats = {name: parameter.detach().clone() for name, parameter in trainer.splats.items()}
    return Refined(trainer.evaluate(), gate, splats)


def test_gated_refinement_skips_and_keeps_quality(densified: tuple[Trainer, dict[str, Any]], gated: Refined) -> None:
    trainer, snapshot = densified
    trainer.restore(snapshot)
    start = trainer.evaluate()
    ungated = refine(densified, enabled=False)
    stats = gated.gate.stats()
    assert stats["gated_iterations"] == CONFIG.max_steps - trainer.refine_stop_iter
    assert stats["backwards_run"] + stats["backwards_skipped"] == stats["gated_iterations"]
    assert stats["backwards_skipped"] > 0.3 * stats["gated_iterations"]
    assert ungated.metrics["psnr"] > 28.6
    assert ungated.metrics["ssim"] > 0.915
    assert gated.metrics["psnr"] > start["psnr"] + 0.25
    assert abs(ungated.metrics["psnr"] - gated.metrics["psnr"]) < 0.3


def test_interrupted_and_resumed_equals_uninterrupted(
    densified: tuple[Trainer, dict[str, Any]], gated: Refined, tmp_path: Path
) -> None:
    trainer, snapshot = densified
    trainer.restore(snapshot)
    with SkipGate(trainer):
        trainer.train(until=CONFIG.max_steps - 300, progress=False)
        trainer.save_checkpoint(tmp_path / "interrupted.pt")

    resumed = Trainer(CONFIG, trainer.scene)
    with SkipGate(resumed) as gate:
        resumed.load_checkpoint(tmp_path / "interrupted.pt")
        resumed.train(progress=False)
    for name, parameter in resumed.splats.items():
        assert torch.equal(parameter, gated.splats[name]), name
    assert gate.stats()["backwards_skipped"] == gated.gate.stats()["backwards_skipped"]
    assert gate.view_table() == gated.gate.view_table()


def test_ply_is_readable_by_another_reader(densified: tuple[Trainer, dict[str, Any]], tmp_path: Path) -> None:
    trainer, _ = densified
    trainer.export_ply(tmp_path / "fern.ply")
    vertex = PlyData.read(tmp_path / "fern.ply")["vertex"]
    assert len(vertex.properties) == 62
    assert vertex.count == len(trainer.splats["means"])
    torch.testing.assert_close(torch.tensor(vertex["opacity"].copy()), trainer.splats["opacities"].detach())
