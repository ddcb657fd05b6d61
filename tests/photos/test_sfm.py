"""The command makes scenes of photographs and videos, and names the photographs that it leaves out."""

from __future__ import annotations

import re
import shutil
import signal
import sqlite3
import subprocess
import time
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image

from skipgs_plug.cli import main
from skipgs_plug.commands import sfm
from skipgs_plug.install import program
from skipgs_plug.photos import global_mapping, reconstruct
from skipgs_plug.photos.links import largest_group
from skipgs_plug.photos.origin import origin_of, read_origin
from skipgs_plug.photos.progress import counted
from skipgs_plug.photos.reconstruct import key_pairs
from skipgs_plug.trainer import load_scene
from skipgs_plug.view.model import open_model

IMAGES = ("images", "images_2", "images_4", "images_8")
# imageio-ffmpeg does not close the pipes of a finished decoder; the garbage collector does.
LEAVES_PIPES = "ignore:unclosed file:ResourceWarning"


@pytest.mark.parametrize("mapping", ["incremental", "global"])
def test_photographs_become_a_scene(photos, tmp_path, capsys, monkeypatch, mapping):
    counted_to = {}

    class Bar(sfm.tqdm):
        """Prints the last number: a fast machine may draw no number between."""

        def close(self):
            counted_to[self.desc] = self.n
            super().close()

    monkeypatch.setattr(sfm, "tqdm", Bar)
    scene = tmp_path / "scenes/fern"
    assert main(["sfm", str(photos), str(scene), "--mapping", mapping]) == 0
    captured = capsys.readouterr()
    assert f"8 of 10 photographs placed (exhaustive matching, {mapping} mapping)" in captured.out
    assert re.search(r"blurred\.png: is blurred", captured.out)
    assert re.search(r"elsewhere\.png: overlaps no other photograph", captured.out)
    placing = "Placing photographs" + (" all at once" if mapping == "global" else "")
    assert f"{placing}: " in captured.err
    assert counted_to[placing] >= 8 if mapping == "incremental" else 3 <= counted_to[placing] <= 6
    assert sorted(path.name for path in scene.iterdir()) == [*IMAGES, "made_of.json", "sparse"]
    assert sorted(path.name for path in scene.parent.iterdir()) == ["fern"]
    assert read_origin(scene) == origin_of(photos) and len(read_origin(scene).sizes) == 10
    loaded = load_scene(scene)
    assert len(loaded.train) == 7 and len(loaded.test) == 1 and len(loaded.points) > 200
    for factor in (2, 8):
        reduced = load_scene(scene, data_factor=factor)
        assert reduced.train[0].width == round(loaded.train[0].width / factor)
    # Points lie in front of the cameras that see them and project into the image.
    view = loaded.train[0]
    seen = loaded.points.double() @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    pixels = (seen @ view.K.T)[:, :2] / seen[:, 2:]
    inside = (seen[:, 2] > 0) & (pixels > 0).all(dim=1) & (pixels[:, 0] < view.width) & (pixels[:, 1] < view.height)
    assert inside.float().mean() > 0.5


@pytest.mark.filterwarnings(LEAVES_PIPES)
def test_a_video_becomes_a_scene(fern, tmp_path, capsys):
    frames = np.stack([np.array(Image.open(path).convert("RGB"))[:188] for path in fern[:8]])
    video = tmp_path / "walk.mp4"
    iio.imwrite(video, frames, plugin="FFMPEG", fps=10, quality=9, macro_block_size=2)
    command = ["sfm", str(video), str(tmp_path / "scene"), "--matching", "sequential", "--no-progress"]
    assert main(command) == 0
    captured = capsys.readouterr()
    assert (
        re.search(r"[78] of 8 photographs placed \(sequential matching, incremental mapping\)", captured.out)
        and captured.err == ""
    )
    names = sorted(path.name for path in (tmp_path / "scene/images").iterdir())
    assert set(names) <= {f"frame_{i:06d}.jpg" for i in range(8)} and len(names) >= 7


@pytest.mark.filterwarnings(LEAVES_PIPES)
def test_a_video_is_trained_on_with_one_command(fern, tmp_path, capsys):
    frames = np.stack([np.array(Image.open(path).convert("RGB"))[:188] for path in fern[:6]])
    video, run = tmp_path / "walk.mp4", tmp_path / "runs/walk"
    iio.imwrite(video, frames, plugin="FFMPEG", fps=10, quality=9, macro_block_size=2)
    train = ["train", str(video), "--out", str(run), "--no-progress", "--data-factor", "4"]
    assert main([*train, "--max-steps", "6"]) == 2
    assert f"{program()} sfm {video} SCENE" in capsys.readouterr().err
    assert not run.exists()
    assert main([*train, "--max-steps", "6", "--sfm"]) == 0
    shown = capsys.readouterr().out
    assert "photographs placed" in shown and shown.count(f"{program()} view {run}") == 1
    last = shown.splitlines()[-1]
    assert last.startswith(f"Next: {program()} view {run}; share it: {run / 'walk.spz'} (")
    assert (run / "walk.spz").is_file()
    assert (run / "scene/sparse/0").is_dir() and (run / "ply/point_cloud_5.ply").is_file()
    assert read_origin(run / "scene") == (str(video), {"walk.mp4": video.stat().st_size})
    video.unlink()  # resuming needs only the scene
    assert main([*train, "--max-steps", "8", "--sfm", "--resume"]) == 0
    assert "placed" not in capsys.readouterr().out
    run = run.rename(tmp_path / "moved")
    model = open_model(run)
    assert model.scene is not None and len(model.scene.train) >= 4


def test_photographs_are_told_from_scenes(fern, tmp_path, capsys):
    photos = tmp_path / "photos"
    (photos / "first day").mkdir(parents=True)
    out = ["--out", str(tmp_path / "run")]
    assert main(["train", str(photos), *out, "--sfm"]) == 2
    assert "is neither a video nor a folder with photographs; leave out --sfm" in capsys.readouterr().err
    (photos / "first day/one.JPG").write_bytes(b"")
    assert main(["train", str(photos), *out]) == 2
    assert "holds photographs but no cameras; add --sfm" in capsys.readouterr().err
    (photos / "transforms.json").write_text("{}")
    assert main(["train", str(photos), *out, "--sfm"]) == 2
    assert "is a scene already; leave out --sfm" in capsys.readouterr().err
    assert main(["train", str(photos), *out]) == 2
    assert "transforms.json" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("make", "arguments", "sentence"),
    [
        (lambda p: None, (), "nowhere does not exist; give a folder of photographs or a video"),
        (lambda p: p.write_text("x"), (), "nowhere is neither a folder nor a video"),
        (lambda p: p.mkdir(), (), "gives no photograph"),
        (lambda p: (p.mkdir(), (p / "a.jpg").write_bytes(b"no")), (), "a.jpg cannot be decoded"),
        (lambda p: (p.mkdir(), (p / "a.HEIC").write_bytes(b"no")), (), "export as JPEG"),
        (lambda p: p.mkdir(), ("--frames", "2"), "--frames 2 is too few"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, capsys, make, arguments, sentence):
    make(tmp_path / "nowhere")
    assert main(["sfm", str(tmp_path / "nowhere"), str(tmp_path / "scene"), *arguments, "--no-progress"]) == 2
    error = capsys.readouterr().err
    assert sentence in error and len(error.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir() if path.name != "nowhere"] == []


def test_no_bar_is_shown_for_what_is_not_there(tmp_path, capsys):
    assert main(["sfm", str(tmp_path / "nowhere"), str(tmp_path / "scene")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_where_all_at_once_fails_photographs_are_placed_one_after_another(fern, tmp_path, capsys, monkeypatch):
    photos, scene = tmp_path / "photos", tmp_path / "scene"
    photos.mkdir()
    for path in fern[:5]:
        shutil.copy(path, photos)
    monkeypatch.setattr(reconstruct, "ALL_AT_ONCE_BEYOND", 4)
    monkeypatch.setattr(global_mapping, "LEAST_POINTS", 1_000_000)  # with this bound no photograph counts as placed
    assert main(["sfm", str(photos), str(scene), "--no-progress"]) == 0
    shown = capsys.readouterr().out
    assert "Global mapping placed 0 of 5 photographs; placing them one after another now." in shown
    assert "5 of 5 photographs placed (exhaustive matching, incremental mapping)" in shown
    assert main(["sfm", str(photos), str(tmp_path / "other"), "--mapping", "global", "--no-progress"]) == 2
    assert "None of the 5 photographs could be placed" in capsys.readouterr().err


def test_an_interrupt_ends_the_process_that_places_all_at_once(fern, tmp_path, monkeypatch):
    started = []

    class Recorded(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            started.append(self)

    def interrupt(stages):
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", Recorded)
    (tmp_path / "database.db").touch()
    with pytest.raises(KeyboardInterrupt):
        global_mapping.map_globally(tmp_path / "database.db", fern[0].parent, tmp_path / "work", interrupt)
    (process,) = started
    assert process.returncode not in (None, 0)  # the process was killed, and its end awaited


def test_a_terminated_run_leaves_nothing(photos, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(reconstruct.Reconstruction, "match", lambda *_: signal.raise_signal(signal.SIGTERM))
    assert main(["sfm", str(photos), str(tmp_path / "scene"), "--no-progress"]) == 143
    assert capsys.readouterr().err == "skipgs-plug: terminated.\n"
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_the_largest_group_hangs_together():
    pairs = ["ab", "bc", "de", "cf"]
    neighbours = {name: {one for pair in pairs if name in pair for one in pair} - {name} for name in "abcdefg"}
    assert largest_group(neighbours) == set("abcf") and largest_group({}) == set()


def test_progress_is_read_by_another_process(tmp_path):
    database = tmp_path / "some ?#% database.db"
    connection = sqlite3.connect(database)
    connection.execute("create table descriptors (k integer)")
    seen = []
    with counted(database, "descriptors", seen.append):
        for total in (2, 5):
            while sum(seen) < total:
                if connection.execute("select count(*) from descriptors").fetchone()[0] < total:
                    connection.execute("insert into descriptors values (1)")
                    connection.commit()
                time.sleep(0.05)
    connection.close()
    assert sum(seen) == 5


def test_a_long_sequence_is_also_compared_across_its_length():
    names = [f"{i:03d}.jpg" for i in range(120)] + ["with a space.jpg"]
    pairs = list(key_pairs(names))
    assert len(pairs) == 40 * 39 / 2 and ("000.jpg", "117.jpg") in pairs
    assert not any(" " in name for pair in pairs for name in pair)


def test_photographs_without_overlap_are_refused_and_leave_nothing(tmp_path, capsys):
    folder = tmp_path / "noise"
    folder.mkdir()
    for i in range(4):
        noise = np.random.default_rng(i).integers(0, 256, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(noise).resize((256, 192)).save(folder / f"{i}.png")
    assert main(["sfm", str(folder), str(tmp_path / "scene"), "--no-progress"]) == 2
    assert "None of the 4 photographs could be placed" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["noise"]


def test_no_folder_is_overwritten(tmp_path, capsys):
    photos, scene = tmp_path / "photos", tmp_path / "scene"
    for folder in (photos, scene):
        folder.mkdir()
        (folder / "kept.txt").write_text("kept")
    assert main(["sfm", str(photos), str(scene)]) == 2
    assert "not an empty folder" in capsys.readouterr().err
    assert main(["sfm", str(photos), str(photos / "scene")]) == 2
    assert "lies in the folder of the photographs" in capsys.readouterr().err
    assert [path.read_text() for path in sorted(Path(tmp_path).rglob("*.txt"))] == ["kept", "kept"]
