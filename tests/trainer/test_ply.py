"""The PLY: read by plyfile, property for property, and by our own reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from skipgs_plug.trainer import InputError, MissingFileError
from skipgs_plug.trainer.ply import read_ply, write_ply


def make_splats(n: int = 7, rest: int = 15) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (rest, 3)}
    return {name: torch.randn(n, *shape, generator=generator) for name, shape in shapes.items()}


def test_second_reader_sees_the_62_properties(tmp_path: Path) -> None:
    splats = make_splats()
    write_ply(splats, tmp_path / "model.ply")
    content = PlyData.read(str(tmp_path / "model.ply"))
    vertices = content["vertex"]
    assert not content.text and content.byte_order == "<"
    names = [p.name for p in vertices.properties]
    assert len(names) == 62
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[54:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert {p.val_dtype for p in vertices.properties} == {"f4"}
    np.testing.assert_array_equal(vertices["y"], splats["means"][:, 1])
    np.testing.assert_array_equal(vertices["opacity"], splats["opacities"])
    np.testing.assert_array_equal(vertices["rot_0"], splats["quats"][:, 0])
    np.testing.assert_array_equal(vertices["nz"], 0)
    # Channel-major: 15 red coefficients, then 15 green, then 15 blue.
    np.testing.assert_array_equal(vertices["f_rest_1"], splats["shN"][:, 1, 0])
    np.testing.assert_array_equal(vertices["f_rest_15"], splats["shN"][:, 0, 1])
    np.testing.assert_array_equal(vertices["f_rest_44"], splats["shN"][:, 14, 2])


def test_round_trip(tmp_path: Path) -> None:
    splats = make_splats()
    write_ply(splats, tmp_path / "model.ply")
    loaded = read_ply(tmp_path / "model.ply")
    for name, tensor in splats.items():
        assert torch.equal(loaded[name], tensor), name


def test_missing_degrees_are_zero(tmp_path: Path) -> None:
    splats = make_splats(rest=3)
    write_ply(splats, tmp_path / "model.ply")
    loaded = read_ply(tmp_path / "model.ply")
    assert torch.equal(loaded["shN"][:, :3], splats["shN"])
    assert not loaded["shN"][:, 3:].any()


def test_bad_files(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    with pytest.raises(MissingFileError, match=r"model\.ply does not exist"):
        read_ply(path)
    write_ply(make_splats(), path)
    whole = path.read_bytes()
    mesh = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n"
    for content in (whole[:-100], whole[:300], b"", b"\xff\xfe garbage", mesh):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"model\.ply is damaged or not a 3DGS model"):
            read_ply(path)
    splats = make_splats()
    splats["scales"][3, 1] = torch.nan
    write_ply(splats, path)
    with pytest.raises(InputError, match=r"model\.ply holds NaN"):
        read_ply(path)
