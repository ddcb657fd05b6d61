"""Files of `--tensorboard`, read back as TensorBoard reads them."""

from __future__ import annotations

import errno
import json
import os
import warnings

import pytest
import torch

from skipgs_plug.cli import main
from skipgs_plug.trainer import TrainConfig, Trainer, save_packed
from skipgs_plug.trainer.loop import Iteration
from skipgs_plug.trainer.scalars import ScalarLog, peak_memory
from skipgs_plug.trainer.synthetic import make_scene

TRAIN = {f"train/{name}" for name in ("loss", "l1loss", "ssimloss", "num_GS", "mem")}
VAL = {"val/psnr", "val/ssim", "val/num_GS"}


@pytest.fixture(scope="module")
def scene():
    return make_scene(n_views=8, width=24, height=16, n_points=60, test_every=4)


@pytest.fixture(scope="module")
def packed(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("packed") / "tiny.npz"
    save_packed(scene, path)
    return str(path)


def read(folder):
    """Return {tag: {step: value}}; a step that stands twice is an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tensorboard's own imports
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    found = {}
    for tag in events.Tags()["scalars"]:
        points = events.Scalars(tag)
        found[tag] = {point.step: point.value for point in points}
        assert len(found[tag]) == len(points)
    return found


def test_train_writes_the_tags_of_gsplat(packed, tmp_path):
    command = ["train", packed, "--out", str(tmp_path), "--max-steps", "40", "--no-progress", "--tensorboard"]
    assert main([*command, "--ssim-lambda", "0.3", "--warmup", "4"]) == 0
    logged = read(tmp_path / "tb")
    assert {tag for tag in logged if not tag.startswith("skipgs/")} == TRAIN | VAL
    for tag in TRAIN:
        assert list(logged[tag]) == [0, 10, 20, 30]
    for step, loss in logged["train/loss"].items():
        l1, ssim = logged["train/l1loss"][step], logged["train/ssimloss"][step]
        assert 0 < l1 < 1 and 0 < ssim < 1 and l1 != pytest.approx(ssim)
        assert loss == pytest.approx(0.7 * l1 + 0.3 * ssim, rel=1e-5)
    stats = json.loads((tmp_path / "stats/val_step39.json").read_text())
    for name in ("psnr", "ssim", "num_GS"):
        assert logged[f"val/{name}"] == {39: pytest.approx(stats[name], rel=1e-6)}
    assert 0 < logged["skipgs/skip_ratio"][30] <= 1


def test_memory_is_in_gib_and_counts_what_was_used():
    before = peak_memory(torch.device("cpu"))
    used = torch.ones(2**26)  # 256 MiB, touched
    assert used[-1] == 1
    assert before is not None and 2**26 < before < 2**37
    assert max(before, 2**28) <= peak_memory(torch.device("cpu")) < before + 2**29


def test_a_continued_run_replaces_what_came_after_its_checkpoint(scene, tmp_path):
    trainer = Trainer(TrainConfig(max_steps=40), scene)
    image = torch.rand(16, 24, 3, generator=torch.Generator().manual_seed(0))
    for first, loss in ((0, 1.0), (20, 2.0)):
        trainer.step = first
        with ScalarLog(tmp_path, trainer) as log:
            for step in range(first, 40):
                log.iteration(Iteration(step, step, "view", loss, image, image))
    assert read(tmp_path)["train/loss"] == {0: 1.0, 10: 1.0, 20: 2.0, 30: 2.0}


def test_a_full_disk_ends_the_curves_and_not_the_run(scene, tmp_path, monkeypatch, caplog):
    trainer = Trainer(TrainConfig(max_steps=40), scene)
    image = torch.rand(16, 24, 3, generator=torch.Generator().manual_seed(0))

    def full(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "events.out")

    with ScalarLog(tmp_path, trainer) as log:
        log.iteration(Iteration(0, 0, "view", 1.0, image, image))
        monkeypatch.setattr(log._writer, "add_scalar", full)
        for step in (10, 20):
            log.iteration(Iteration(step, step, "view", 1.0, image, image))
    assert list(read(tmp_path)["train/loss"]) == [0]
    assert caplog.text.count("events.out cannot be written (No space left on device)") == 1


def test_bench_writes_every_run(packed, tmp_path):
    out = tmp_path / "bench"
    command = ["bench", packed, "--out", str(out), "--max-steps", "40", "--seeds", "3", "--no-progress"]
    policies = ("own", "gate", "random")
    assert main([*command, "--policies", *policies, "--tensorboard"]) == 0
    assert {path.name for path in (out / "tb").iterdir()} == {f"seed3_{name}" for name in ("densify", *policies)}
    densify = read(out / "tb" / "seed3_densify")
    assert set(densify) == TRAIN and list(densify["train/l1loss"]) == [0, 10]
    for policy in policies:
        logged = read(out / "tb" / f"seed3_{policy}")
        gated = {tag for tag in logged if tag.startswith("skipgs/")}
        assert set(logged) - gated == TRAIN | VAL and bool(gated) == (policy != "own")
        assert list(logged["train/mem"]) == [20, 30]
        run = json.loads((out / "runs" / f"seed3_{policy}.json").read_text())
        assert logged["val/psnr"] == {p["step"] - 1: pytest.approx(p["psnr"], rel=1e-6) for p in run["points"]}
        assert logged["train/loss"][30] == pytest.approx(run["trace"]["loss"][10], rel=1e-4)
