"""3DGS models as the 62-property INRIA PLY, in the coordinates of the dataset, and point clouds."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.errors import InputError, MissingFileError, reason
from skipgs_plug.trainer.files import write_aside
from skipgs_plug.trainer.scene import check_points

REST = 15  # coefficients of SH degrees 1 to 3
REST_COUNTS = (0, 9, 24, 45)  # f_rest properties of SH degrees 0 to 3
MAX_LOG_SCALE = 80.0  # float32 overflows at e^88
MAX_HEADER = 1 << 16
PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(3 * REST)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)


def write_ply(splats: Mapping[str, Tensor], path: str | Path) -> None:
    """Write raw values: logit opacity, log scale, wxyz as trained, zero normals.

    `f_rest` is channel-major (15 red, 15 green, 15 blue); missing SH degrees are written as zeros.
    """
    from plyfile import PlyData, PlyElement

    values = {name: tensor.detach().cpu().float() for name, tensor in splats.items()}
    n = len(values["means"])
    rest = torch.zeros(n, REST, 3)
    rest[:, : values["shN"].shape[1]] = values["shN"]
    columns = [
        values["means"],
        torch.zeros(n, 3),
        values["sh0"].reshape(n, 3),
        rest.transpose(1, 2).reshape(n, 3 * REST),
        values["opacities"].reshape(n, 1),
        values["scales"],
        values["quats"],
    ]
    table = torch.cat(columns, dim=1).numpy()
    vertices = np.empty(n, dtype=[(name, "<f4") for name in PROPERTIES])
    for i, name in enumerate(PROPERTIES):
        vertices[name] = table[:, i]
    with write_aside(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(temporary))


def read_ply(path: str | Path) -> dict[str, Tensor]:
    """Read a 3DGS model of SH degree 0 to 3, raw values; normals are optional and ignored.

    Returns:
        `means [N, 3]`, `scales [N, 3]` (log), `quats [N, 4]` (wxyz, any length but 0), `opacities [N]` (logit),
        `sh0 [N, 1, 3]` and `shN [N, K - 1, 3]`, float32 on the CPU.

    Raises:
        MissingFileError: no such file.
        InputError: not a PLY, truncated, not a Gaussian PLY, empty, or with values that cannot be rendered.
    """
    return model_of(Path(path), read_vertices(Path(path)))


def read_points(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a point cloud: positions [M, 3] float32 and colours [M, 3] uint8, grey where the file has none.

    Raises:
        MissingFileError: no such file.
        InputError: not a PLY, truncated, without x, y and z, or with values that are not finite.
    """
    return points_of(Path(path), read_vertices(Path(path)))


def read_start(path: str | Path) -> tuple[tuple[np.ndarray, np.ndarray], dict[str, Tensor] | None]:
    """Read what training may start from: positions and colours as `read_points`, and, of a 3DGS model, its Gaussians.

    Raises:
        MissingFileError: no such file.
        InputError: neither a point cloud nor a model, or of fewer than four points.
    """
    path = Path(path).expanduser()
    vertices = read_vertices(path)
    cloud = points_of(path, vertices)
    check_points(cloud[0], path)
    return cloud, model_of(path, vertices) if "f_dc_0" in vertices else None


def model_of(path: Path, vertices: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Return the Gaussians of `read_ply`."""
    count = sum(name.startswith("f_rest_") for name in vertices)
    if count not in REST_COUNTS:
        raise InputError(f"PLY {path} has {count} f_rest properties, expected one of {REST_COUNTS}; export it again.")
    names = [n for n in PROPERTIES if n[0] != "n" and (not n.startswith("f_rest") or int(n[7:]) < count)]
    lacking = [name for name in names if name not in vertices]
    if lacking:
        raise InputError(f"PLY {path} is not a 3DGS model: it lacks {', '.join(lacking[:4])}; export it again.")
    table = columns(path, vertices, names)
    if not len(table):
        raise InputError(f"PLY {path} holds no Gaussians; export it again from a sound checkpoint.")
    means, sh0, rest, opacity, scales, quats = torch.from_numpy(table).split([3, 3, count, 1, 3, 4], dim=1)
    if (quats == 0).all(dim=1).any():
        raise InputError(f"PLY {path} holds rotations of length 0; export it again from a sound checkpoint.")
    if float(scales.max()) > MAX_LOG_SCALE:
        raise InputError(f"PLY {path} holds scales above e^{MAX_LOG_SCALE:g}: they must be logarithms.")
    return {
        "means": means.contiguous(),
        "scales": scales.contiguous(),
        "quats": quats.contiguous(),
        "opacities": opacity[:, 0].contiguous(),
        "sh0": sh0[:, None, :].contiguous(),
        "shN": rest.reshape(-1, 3, count // 3).transpose(1, 2).contiguous(),
    }


def points_of(path: Path, vertices: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and colours of `read_points`."""
    if not {"x", "y", "z"} <= set(vertices):
        raise InputError(f"PLY {path} has no vertices with x, y and z; give a point cloud.")
    positions = columns(path, vertices, ["x", "y", "z"])
    names = ["red", "green", "blue"]
    if not set(names) <= set(vertices):
        return positions, np.full(positions.shape, 128, dtype=np.uint8)
    colours = columns(path, vertices, names)
    if vertices["red"].dtype.kind == "f":  # in [0, 1] by convention
        colours = colours * 255
    return positions, np.rint(colours.clip(0, 255)).astype(np.uint8)


def read_vertices(path: Path) -> dict[str, np.ndarray]:
    """Return the vertices' properties [N] by name; what the header claims is checked before anything is allocated."""
    from plyfile import PlyData, PlyParseError

    check_header(path)
    try:
        vertices = PlyData.read(str(path), mmap=False)["vertex"]
        return {prop.name: np.asarray(vertices[prop.name]) for prop in vertices.properties}
    except (PlyParseError, KeyError, ValueError, TypeError, EOFError, MemoryError, OSError) as error:
        raise InputError(f"PLY {path} is damaged or not a PLY ({reason(error)}); export it again.") from error


def check_header(path: Path) -> None:
    """Refuse counts that the file cannot hold: each value takes a byte at least, and vertices have no lists."""
    if not os.path.isfile(path):
        raise MissingFileError(f"PLY {path} does not exist; give the path of a PLY file.")
    try:
        with open(path, "rb") as stream:
            size, head = os.fstat(stream.fileno()).st_size, stream.read(MAX_HEADER)
    except OSError as error:
        raise InputError(f"PLY {path} cannot be read ({reason(error)}).") from error
    header, found, _ = head.partition(b"end_header")
    if not header.startswith(b"ply") or not found:
        raise InputError(f"PLY {path} is damaged or not a PLY (no header); export it again.")
    element, count, needed = b"", 0, len(header)
    for line in header.splitlines():
        words = line.split()
        if words[:1] == [b"element"]:
            if len(words) != 3 or not words[2].isdigit() or len(words[2]) > 19:
                raise InputError(f"PLY {path} is damaged: {line[:80]!r} in its header; export it again.")
            element, count = words[1], int(words[2])
        elif words[:1] == [b"property"]:
            needed += count
            if element == b"vertex" and words[1:2] == [b"list"]:
                raise InputError(f"PLY {path} has lists in its vertices, so it is neither a model nor a point cloud.")
    if needed > size:
        raise InputError(f"PLY {path} is damaged: it claims {needed:,} bytes at least, has {size:,}; export it again.")


def columns(path: Path, vertices: Mapping[str, np.ndarray], names: list[str]) -> np.ndarray:
    """Return the named properties as a finite table [N, len(names)] float32."""
    with np.errstate(over="ignore"):
        table = np.stack([vertices[name].astype(np.float32) for name in names], axis=1)
    if not np.isfinite(table).all():
        raise InputError(f"PLY {path} holds NaN or infinite values; export it again from a sound checkpoint.")
    return table
