"""The runner of other projects' scripts: its command, and the record of a run, with a stand-in for the interpreter."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks import unmodified_scripts
from benchmarks.pictures import measure_pictures
from benchmarks.script_rows import Row
from benchmarks.script_table import table
from benchmarks.sized_scene import sized_scene

# Stands for Python: it logs its arguments, and writes the report and the pictures of a run of gsplat.
STAND_IN = """#!/bin/sh
echo "$@"
for last; do :; done
cp -r {ready}/. "$last"
exit {code}
"""
REPORT = {"iterations_skipped": 20, "refine_share": 0.4, "growing": {"iterations_skipped": 10, "events_run": 3}}


@pytest.fixture
def checkouts(tmp_path: Path) -> Path:
    """A folder with a checkout, and a folder with the files that the stand-in's run leaves."""
    (tmp_path / "checkouts/project").mkdir(parents=True)
    (tmp_path / "ready/renders").mkdir(parents=True)
    (tmp_path / "fern").mkdir()
    (tmp_path / "fern/drawn.json").write_text('{"points": 10, "seed": 0}')
    pair = np.full((16, 32, 3), 100, np.uint8)  # photograph and render side by side
    pair[:, 16:] = 110
    Image.fromarray(pair).save(tmp_path / "ready/renders/val_step99_0000.png")
    (tmp_path / "ready/skipgs.json").write_text(json.dumps(REPORT))
    return tmp_path / "checkouts"


def run(checkouts: Path, monkeypatch: pytest.MonkeyPatch, mode: str = "auto", code: int = 0, render: str = "") -> dict:
    """Run the row once, and return its record."""
    folder = checkouts.parent
    stand_in = folder / "python"
    stand_in.write_text(STAND_IN.format(ready=folder / "ready", code=code))
    stand_in.chmod(0o755)
    command = "train.py -s {scene} -n {n} --half {half} -m {out}"
    row = Row("Tiny", "nobody/tiny", "project", command, pictures=True, render=render)
    monkeypatch.setattr(sys, "executable", str(stand_in))
    monkeypatch.setitem(unmodified_scripts.ROWS, "tiny", row)
    monkeypatch.setattr(unmodified_scripts, "named", lambda scene, factor: f"{scene.name} at 1/{factor}")
    runs = folder / "runs.json"
    unmodified_scripts.run("tiny", mode, checkouts, folder / "fern", 4, 100, folder / "out", runs)
    return json.loads(runs.read_text())["runs"][-1]


def test_run_is_recorded_with_its_command_seconds_quality_and_report(checkouts, monkeypatch):
    record = run(checkouts, monkeypatch)
    assert record["command"] == "skipgs-plug run auto --cpu --share auto -- train.py -s fern -n 100 --half 50 -m OUT"
    assert (record["scene"], record["script"], record["mode"]) == ("fern at 1/4", "Tiny", "auto")
    assert record["exit_code"] == 0 and record["views"] == 1 and record["gaussians"] is None
    assert record["psnr"] == pytest.approx(20 * np.log10(255 / 10), abs=1e-3)
    assert (record["iterations_run"], record["refine_share"], record["events_run"]) == (70, 0.4, 3)
    assert record["seconds"] >= 0 and record["peak_rss_gib"] >= 0 and record["project_commit"] is None
    log = checkouts.parent / "out/tiny.fern.4.100.auto/log.txt"
    assert log.read_text().startswith("-P -m skipgs_plug run auto --cpu --share auto -- train.py ")


def test_second_run_replaces_the_record_of_the_same_mode_alone(checkouts, monkeypatch):
    assert "--no-gate" in run(checkouts, monkeypatch, "own")["command"]
    run(checkouts, monkeypatch)
    run(checkouts, monkeypatch)
    runs = json.loads((checkouts.parent / "runs.json").read_text())["runs"]
    runs = [{**one, "seconds": 1.0} for one in runs]  # the stand-in takes no options
    assert [one["mode"] for one in runs] == ["own", "auto"]
    assert "| Tiny | 100 | 70 |" in table(runs)


def test_script_that_fails_is_named_with_its_log(checkouts, monkeypatch, capsys):
    assert run(checkouts, monkeypatch, code=3)["exit_code"] == 3
    assert "The script ended with 3; its log is " in capsys.readouterr().err


def test_script_without_pictures_or_a_model_records_nothing(checkouts, monkeypatch):
    (checkouts.parent / "ready/renders/val_step99_0000.png").unlink()
    (checkouts.parent / "ready/renders").rmdir()
    with pytest.raises(SystemExit, match=r"no pictures of held-out views in .*Nothing was recorded; .*log\.txt"):
        run(checkouts, monkeypatch)
    assert not (checkouts.parent / "runs.json").exists()
    with pytest.raises(FileNotFoundError, match="no point_cloud"):
        unmodified_scripts.newest(checkouts, "point_cloud*.ply")


def test_pictures_that_another_command_renders_and_gaussians_of_a_checkpoint_are_recorded(checkouts, monkeypatch):
    model = checkouts.parent / "ready/run/model/step-000000099.ckpt"
    model.parent.mkdir(parents=True)
    torch.save({"pipeline": {"_model.gauss_params.means": torch.zeros(7, 3)}}, model)
    record = run(checkouts, monkeypatch, render="-m eval {out}")
    assert record["gaussians"] == 7 and record["views"] == 1 and "eval" not in record["command"]
    log = checkouts.parent / "out/tiny.fern.4.100.auto/render.txt"
    assert log.read_text().startswith("-P -m skipgs_plug run auto --cpu --no-gate -- -m eval ")


def test_pictures_of_nerfstudio_have_the_photograph_on_the_left(tmp_path):
    pair = np.zeros((16, 48, 3), np.uint8)
    pair[:, 24:] = 51
    for number in (0, 1):
        Image.fromarray(pair).save(tmp_path / f"eval_img_000{number}.png")
    measured = measure_pictures(tmp_path)
    assert measured["views"] == 2 and measured["psnr"] == pytest.approx(20 * np.log10(5), abs=1e-3)


def test_sized_scene_has_cameras_of_the_photographs_and_lists_every_eighth_by_name(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    names = [f"{number:02}.png" for number in range(9)]
    (tmp_path / "scene/sparse/0").mkdir(parents=True)
    (tmp_path / "scene/images_4").mkdir()
    for name in names:
        Image.new("RGB", (10, 7)).save(tmp_path / "scene/images_4" / name)
    model = tmp_path / "scene/sparse/0"
    (model / "cameras.txt").write_text("1 SIMPLE_PINHOLE 40 26 50 20 13\n")
    images = [f"{number + 1} 1 0 0 0 0 0 0 1 {name}\n\n" for number, name in enumerate(reversed(names))]
    (model / "images.txt").write_text("".join(images))
    (model / "points3D.txt").write_text("")
    sized_scene(tmp_path / "scene", 4, tmp_path / "sized")
    camera = pycolmap.Reconstruction(str(tmp_path / "sized/sparse/0")).cameras[1]
    assert (camera.width, camera.height) == (10, 7)
    assert list(camera.params) == pytest.approx([50 / 4, 50 * 7 / 26, 5, 3.5])
    lists = {split: (tmp_path / f"sized/{split}_list.txt").read_text().split() for split in ("train", "val", "test")}
    assert lists == {"train": names[1:8], "val": [names[0], names[8]], "test": [names[0], names[8]]}
    assert sorted(path.name for path in (tmp_path / "sized/images").iterdir()) == names


def test_table_has_means_over_draws_of_the_points_and_each_difference():
    def one(mode, seed, psnr, **changed):
        run = {"scene": "fern", "script": "Tiny", "iterations": 100, "mode": mode, "points_seed": seed, "psnr": psnr}
        run |= {"package_commit": "1"}
        return {**run, "iterations_run": 40, "seconds": 2.0, "gaussians": 10, "ssim": 0.5, **changed}

    runs = [one("own", 0, 30.0), one("auto", 0, 31.0, seconds=1.0, gaussians=None)]
    assert table(runs).splitlines()[4] == (
        "| Tiny | 100 | 40 | 2 | 1 | 50 | 10 |  | 30.00 (0.5000) | 31.00 (0.5000) | +1.00 |"
    )
    runs += [one("own", 1, 32.0, seconds=4.0, ssim=0.6), one("own", 2, 20.0)]  # the last one lacks the other mode
    runs += [one("auto", 1, 31.5, gaussians=30, iterations_run=50, busy_core=True)]
    assert table(runs).splitlines()[4] == (
        "| Tiny | 100 | 45 | 3 | 2* | 50 | 10 |  | 31.00 (0.5500) | 31.25 (0.5000) | +0.25 (+1.00, -0.50) |"
    )
    assert "In 2 of 2 pairs both runs are from one version" in table(runs)
    runs[-1]["package_commit"] = "2"
    assert "In 1 of 2 pairs both runs are from one version" in table(runs)
