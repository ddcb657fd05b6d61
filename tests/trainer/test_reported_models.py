"""Public reports about files of models, each rebuilt as a small input; SITUATIONS.md lists their sources."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from test_situations import gaussians, write_columns, write_model

from skipgs_plug.cli import main
from skipgs_plug.trainer import InputError
from skipgs_plug.trainer.ply import read_ply, read_points
from skipgs_plug.view.model import open_snapshots


@pytest.mark.parametrize("prefix", ["scalar_", "scal_", "scalar_scal_"])
def test_a_model_from_cloudcompare(tmp_path: Path, prefix: str) -> None:
    splats = gaussians(1)
    write_model(tmp_path / "model.ply", splats)
    vertices = PlyData.read(tmp_path / "model.ply")["vertex"].data
    columns = {(n if n in "xyz" else prefix + n): vertices[n].astype("f8") for n in vertices.dtype.names}
    write_columns(tmp_path / "edited.ply", columns)
    for name, values in read_ply(tmp_path / "edited.ply").items():
        assert torch.equal(values, splats[name]), name


def test_flat_gaussians_of_degree_0_survive_compression(tmp_path: Path) -> None:
    splats = gaussians(0, 257)  # one Gaussian more than a chunk holds
    splats["scales"][:, 2] = -math.inf
    splats["opacities"] = splats["opacities"].abs()
    write_model(tmp_path / "flat.ply", splats)
    assert main(["export", str(tmp_path / "flat.ply"), str(tmp_path / "flat.compressed.ply")]) == 0
    read = read_ply(tmp_path / "flat.compressed.ply")
    assert len(read["means"]) == 257
    assert float(torch.cdist(read["means"], splats["means"]).min(dim=1).values.max()) < 0.02
    assert float(read["scales"][:, 2].max()) < -15


HEADER_CHANGES = {
    "comments": lambda header: header.replace(b"\nelement", b"\ncomment Brush\ncomment up: y\nelement", 1),
    "obj_info": lambda header: header.replace(b"\nelement", b"\nobj_info num_cols 3\nelement", 1),
    "CRLF": lambda header: header.replace(b"\n", b"\r\n"),
}


@pytest.mark.parametrize("change", HEADER_CHANGES.values(), ids=HEADER_CHANGES)
def test_headers_of_other_programs(tmp_path: Path, change) -> None:
    splats = gaussians(1, 40)
    write_model(tmp_path / "model.ply", splats)
    header, end, body = (tmp_path / "model.ply").read_bytes().partition(b"end_header\n")
    (tmp_path / "model.ply").write_bytes(change(header + end) + body)
    for name, values in read_ply(tmp_path / "model.ply").items():
        assert torch.equal(values, splats[name]), name


@pytest.mark.parametrize("eol", ["\n", "\r\n"])
def test_a_text_ply_with_blank_lines(tmp_path: Path, eol: str) -> None:
    header = ["ply", "format ascii 1.0", "element vertex 4", *(f"property float {n}" for n in "xyz"), "end_header"]
    lines = [*header, "", *(f"{i} {i + 0.5}  {-i} " for i in range(4)), "", ""]
    (tmp_path / "cloud.ply").write_bytes(eol.join(lines).encode())
    np.testing.assert_array_equal(read_points(tmp_path / "cloud.ply")[0][:, 1], np.arange(4) + 0.5)


def spz(version: int, quats: bytes, flags: int = 0) -> bytes:
    import gzip

    position = np.array([1.5, -2.0, 0.25])
    places = (
        position.astype("<f2").tobytes()
        if version == 1
        else np.rint(position * 4096).astype("<i4").view(np.uint8).reshape(3, 4)[:, :3].tobytes()
    )
    head = struct.pack("<IIIBBBB", 0x5053474E, version, 1, 0, 12, flags, 0)
    return gzip.compress(head + places + bytes([128]) + bytes([128, 128, 128]) + bytes([80, 96, 112]) + quats)


@pytest.mark.parametrize(
    ("version", "quats"),
    [(1, bytes([128, 128, 217])), (2, bytes([128, 128, 217])), (3, struct.pack("<I", 3 << 30 | 511))],
)
def test_versions_of_spz(tmp_path: Path, version: int, quats: bytes) -> None:
    """A quarter turn around the axis that looks back there, and forth here."""
    (tmp_path / "one.spz").write_bytes(spz(version, quats))
    (snapshot,) = open_snapshots(tmp_path / "one.spz")
    read = snapshot.load()
    torch.testing.assert_close(read["means"], torch.tensor([[1.5, 2.0, -0.25]]))
    torch.testing.assert_close(read["scales"], torch.tensor([[-5.0, -4.0, -3.0]]))
    half = math.sqrt(0.5)
    torch.testing.assert_close(read["quats"], torch.tensor([[half, 0, 0, -half]]), rtol=0, atol=0.01)


def test_other_versions_of_spz_are_named(tmp_path: Path) -> None:
    cases = {
        "is an SPZ of version 4 or later": struct.pack("<II", 0x5053474E, 4) + bytes(40),
        "version 7 and SH degree 0": spz(7, bytes(3)),
        "with extensions": spz(2, bytes(3), flags=2),
        "damaged or not an SPZ": b"no zip",
        "bytes for 1 Gaussians": spz(3, bytes(3)),
    }
    for said, data in cases.items():
        (tmp_path / "one.spz").write_bytes(data)
        with pytest.raises(InputError, match=said):
            open_snapshots(tmp_path / "one.spz")[0].load()
