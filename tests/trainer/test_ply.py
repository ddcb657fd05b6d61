"""The PLY: read by plyfile, property for property, and by our own reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from skipgs_plug.trainer import InputError, MissingFileError
from skipgs_plug.trainer.ply import PROPERTIES, read_ply, read_points, write_ply


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


def write_table(path: Path, table: dict[str, np.ndarray], text: bool = False) -> None:
    vertices = np.empty(len(table["x"]), dtype=[(name, column.dtype) for name, column in table.items()])
    for name, column in table.items():
        vertices[name] = column
    PlyData([PlyElement.describe(vertices, "vertex")], text=text).write(str(path))


def test_lower_degrees_without_normals_and_in_double(tmp_path: Path) -> None:
    splats = make_splats(rest=3)
    write_ply(splats, tmp_path / "model.ply")
    whole = PlyData.read(str(tmp_path / "model.ply"))["vertex"]
    # 9 of 45 properties in channel-major order: three coefficients of each channel.
    rest = {f"f_rest_{3 * c + k}": whole[f"f_rest_{15 * c + k}"].astype("f8") for c in range(3) for k in range(3)}
    kept = [n for n in PROPERTIES if n[0] != "n" and not n.startswith("f_rest")]
    write_table(tmp_path / "small.ply", {**{n: whole[n].astype("f8") for n in kept}, **rest}, text=True)
    loaded = read_ply(tmp_path / "small.ply")
    for name, tensor in splats.items():
        torch.testing.assert_close(loaded[name], tensor)


def test_bad_files(tmp_path: Path) -> None:
    path = tmp_path / "model.ply"
    with pytest.raises(MissingFileError, match=r"model\.ply does not exist"):
        read_ply(path)
    write_ply(make_splats(), path)
    whole = path.read_bytes()
    for content in (whole[:-100], whole[:300], b"", b"\xff\xfe garbage", whole.replace(b"vertex 7", b"vertex x")):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"model\.ply is damaged"):
            read_ply(path)
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
    with pytest.raises(InputError, match=r"model\.ply is not a 3DGS model: it lacks y, z, f_dc_0, f_dc_1"):
        read_ply(path)
    path.write_bytes(whole.replace(b"property float f_rest_44\n", b""))
    with pytest.raises(InputError, match=r"model\.ply has 44 f_rest properties"):
        read_ply(path)
    write_ply({name: tensor[:0] for name, tensor in make_splats().items()}, path)
    with pytest.raises(InputError, match=r"model\.ply holds no Gaussians"):
        read_ply(path)


@pytest.mark.parametrize("count", [2**31, 2**40, 2**62])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_count_in_the_header_is_checked_before_memory_is_taken(tmp_path: Path, count: int, form: str) -> None:
    path = tmp_path / "model.ply"
    path.write_text(f"ply\nformat {form} 1.0\nelement vertex {count}\nproperty float x\nend_header\n1\n")
    with pytest.raises(InputError, match=r"model\.ply is damaged: its header claims at least [\d,]+ bytes"):
        read_ply(path)
    path.write_text(f"ply\nformat {form} 1.0\nelement vertex 1\nproperty list uint float x\nend_header\n\xff")
    with pytest.raises(InputError, match=r"model\.ply has lists in its vertices"):
        read_ply(path)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("scales", torch.nan, "holds NaN"),
        ("scales", 100.0, "they must be logarithms"),
        ("quats", 0.0, "rotations of length 0"),
    ],
)
def test_values_that_cannot_be_rendered(tmp_path: Path, name: str, value: float, sentence: str) -> None:
    splats = make_splats()
    splats[name][3] = value
    write_ply(splats, tmp_path / "model.ply")
    with pytest.raises(InputError, match=r"model\.ply " + sentence + "|" + sentence):
        read_ply(tmp_path / "model.ply")


def test_point_clouds(tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    xyz = np.arange(12.0).reshape(4, 3)
    table = {name: xyz[:, i] for i, name in enumerate("xyz")}
    rgb = np.array([[0, 128, 255]] * 4, dtype=np.uint8)
    for colours in (rgb, (rgb / 255).astype("f4")):
        write_table(path, {**table, **{name: colours[:, i] for i, name in enumerate(("red", "green", "blue"))}})
        points, loaded = read_points(path)
        np.testing.assert_array_equal(points, xyz)
        np.testing.assert_array_equal(loaded, rgb)
    write_table(path, table)
    assert (read_points(path)[1] == 128).all()
    write_table(path, {"x": xyz[:, 0]})
    with pytest.raises(InputError, match=r"points\.ply has no vertices with x, y and z"):
        read_points(path)
