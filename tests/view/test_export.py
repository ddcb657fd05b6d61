"""Formats of web viewers, decoded by hand."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest
import torch
import yaml

from skipgs_plug.cli import main
from skipgs_plug.trainer.ply import read_ply, write_ply
from skipgs_plug.view.model import open_snapshots

SPLAT = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def test_splat_holds_every_gaussian(ply, tmp_path, capsys):
    out = tmp_path / "model.splat"
    assert main(["export", str(ply), str(out)]) == 0
    splats = read_ply(ply)
    assert f"{len(splats['means']):,} Gaussians" in capsys.readouterr().out
    rows = np.frombuffer(out.read_bytes(), dtype=SPLAT)
    assert len(rows) == len(splats["means"])
    order = np.lexsort(splats["means"].numpy().T)
    rows = rows[np.lexsort(rows["means"].T)]
    assert np.array_equal(rows["means"], splats["means"].numpy()[order])
    assert np.allclose(rows["scales"], splats["scales"].exp().numpy()[order], rtol=1e-5)
    opacity = 255 * torch.sigmoid(splats["opacities"]).numpy()[order]
    assert np.abs(rows["rgba"][:, 3] - opacity).max() <= 1
    red = 255 * (0.5 + 0.28209479 * splats["sh0"][:, 0, 0].numpy()[order])
    assert np.abs(rows["rgba"][:, 0] - red.clip(0, 255)).max() <= 1


def test_a_run_folder_is_exported_compressed_and_as_ply(run_folder, ply, tmp_path):
    assert main(["export", str(run_folder), str(tmp_path / "model.compressed.ply")]) == 0
    header = (tmp_path / "model.compressed.ply").read_bytes().split(b"end_header")[0].decode()
    assert "element chunk" in header and "property uint packed_position" in header
    assert main(["export", str(run_folder), str(tmp_path / "model.ply")]) == 0
    first, second = read_ply(ply), read_ply(tmp_path / "model.ply")
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("name", ["model.obj", "model"])
def test_other_endings_are_refused(ply, tmp_path, capsys, name):
    assert main(["export", str(ply), str(tmp_path / name)]) == 2
    assert "use .compressed.ply, .splat, .spz, .sog or .ply" in capsys.readouterr().err


def test_a_run_is_exported_without_its_scene(run_folder, tmp_path, capsys):
    moved = tmp_path / "moved"
    shutil.copytree(run_folder, moved)
    configuration = yaml.safe_load((moved / "cfg.yml").read_text())
    (moved / "cfg.yml").write_text(yaml.safe_dump({**configuration, "data_dir": str(tmp_path / "gone")}))
    assert main(["export", str(moved), str(tmp_path / "model.splat")]) == 0, capsys.readouterr().err
    assert (tmp_path / "model.splat").stat().st_size % SPLAT.itemsize == 0


FEET = torch.tensor([1.6e6, 17.8e6, 300.0], dtype=torch.float64)  # UTM coordinates in feet
METRES = torch.tensor([5e5, 4.5e6, 120.0], dtype=torch.float64)


def moved(ply, out, shift, kind):
    """Write a model [N] far from the origin, opaque enough for every format, and return its positions."""
    splats = read_ply(ply)
    splats["means"] = (splats["means"] + shift).to(kind)
    splats["opacities"] = splats["opacities"].clamp(min=0.0)
    write_ply(splats, out)
    return splats["means"].double()


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_positions_beyond_those_of_spz_are_refused_and_nothing_is_written(ply, tmp_path, capsys, kind):
    moved(ply, tmp_path / "far.ply", FEET, kind)
    assert main(["export", str(tmp_path / "far.ply"), str(tmp_path / "out.spz")]) == 2
    error = capsys.readouterr().err
    assert "up to 8,388,607, and this model has 17,8" in error and "write a .ply or a .sog" in error
    assert error.count("\n") == 1 and [path.name for path in tmp_path.iterdir()] == ["far.ply"]


@pytest.mark.parametrize(
    ("ending", "kind", "warns"),
    [
        (".spz", torch.float64, True),
        (".spz", torch.float32, True),  # 23 bits keep less than float32's 24
        (".splat", torch.float64, True),
        (".splat", torch.float32, False),
        (".compressed.ply", torch.float64, True),
    ],
)
def test_the_stated_rounding_bounds_what_happens_far_from_the_origin(ply, tmp_path, caplog, ending, kind, warns):
    means = moved(ply, tmp_path / "far.ply", METRES, kind)
    out = tmp_path / f"out{ending}"
    assert main(["export", str(tmp_path / "far.ply"), str(out)]) == 0
    stated = re.findall(r"rounded by up to (\S+) units", caplog.text)
    assert bool(stated) == warns
    read = open_snapshots(out)[-1].load()["means"].double()
    # Formats reorder Gaussians. The largest difference of sorted columns is at most that of the Gaussians.
    error = float((read.sort(dim=0).values - means.sort(dim=0).values).abs().max())
    assert error <= 1.05 * float(stated[0] if stated else 0.0)  # two digits are printed
