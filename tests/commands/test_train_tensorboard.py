from __future__ import annotations

import warnings

from skipgs_plug.cli import main
from skipgs_plug.trainer import save_packed
from skipgs_plug.trainer.synthetic import make_scene


def test_scalars_carry_the_tags_of_gsplat(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tensorboard's own imports
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    scene, out = tmp_path / "tiny.npz", tmp_path / "run"
    save_packed(make_scene(n_views=8, width=24, height=16, n_points=60, test_every=4), scene)
    command = [
        "train",
        str(scene),
        "--out",
        str(out),
        "--max-steps",
        "40",
        "--no-progress",
        "--tensorboard",
        "--gate.warmup",
        "4",
    ]
    assert main(command) == 0

    logged = {}
    for file in (out / "tb").iterdir():
        events = EventAccumulator(str(file))
        events.Reload()
        logged.update({tag: events.Scalars(tag) for tag in events.Tags()["scalars"]})
    assert {"train/loss", "train/num_GS", "val/psnr", "val/ssim", "val/num_GS", "skipgs/skip_ratio"} <= set(logged)
    assert [event.step for event in logged["train/loss"]] == [0, 10, 20, 30]
    assert logged["val/psnr"][0].step == 39 and logged["val/psnr"][0].value > 5
    assert 0 < logged["skipgs/skip_ratio"][-1].value <= 1
