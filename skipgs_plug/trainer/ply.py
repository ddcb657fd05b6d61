"""3DGS models as the 62-property INRIA PLY, in the coordinates of the dataset, and point clouds."""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.install import next_command
from skipgs_plug.trainer.compressed_ply import MAX_LOGIT, decompress, is_compressed
from skipgs_plug.trainer.errors import InputError, MissingFileError, reason
from skipgs_plug.trainer.files import write_aside
from skipgs_plug.trainer.frame import is_far
from skipgs_plug.trainer.lfs import HINT, is_pointer
from skipgs_plug.trainer.scene import check_points
from skipgs_plug.trainer.sh0 import colours_of_sh0

log = logging.getLogger(__name__)

HIGHER_COEFFICIENTS = 15  # number of SH coefficients of degrees 1 to 3 for each colour channel
SATURATING = ("opacity", "scale_0", "scale_1", "scale_2")  # may be infinite in a saturated model
F_REST_COUNTS = (0, 9, 24, 45)  # numbers of f_rest properties of SH degrees 0 to 3
MAX_LOG_SCALE = 80.0  # largest logarithm of a scale in a file: float32 overflows at e^88
MIN_LOG_SCALE = -40.0  # smallest logarithm of a scale: the square of e^-40 is still a normal float32
# Most bytes of a header: those of 3DGS files have about 2 KB, and a damaged file may have no end_header.
MAX_HEADER = 1 << 16
COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
BRIGHTEST = 2.0  # float colours up to this value have a range of 0 to 1; in a range of 0 to 255 they would be black
PACKED_COLOURS = ("rgb", "rgba")  # format of the Point Cloud Library: one number with bytes 0xAARRGGBB
PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
    *(f"f_rest_{i}" for i in range(3 * HIGHER_COEFFICIENTS)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
WIDTHS = (3, 3, 3 * HIGHER_COEFFICIENTS, 1, 3)  # numbers of properties after the position: normal, SH, opacity, scale


def sh_degree(coefficients: int) -> int:
    """Return the SH degree with this number of coefficients beyond the constant one: 0, 3, 8 or 15."""
    return round((coefficients + 1) ** 0.5) - 1


def write_ply(splats: Mapping[str, Tensor], path: str | Path) -> None:
    """Write raw values: logit opacity, log scale, wxyz as trained, zero normals.

    `f_rest` is channel-major (15 red, 15 green, 15 blue); missing SH degrees are written as zeros.
    """
    from plyfile import PlyData, PlyElement

    values = saturated({name: tensor.detach().cpu().float() for name, tensor in splats.items()}, path)
    positions = splats["means"].detach().cpu()  # float64 where float32 would lose some
    n, kind, others = len(positions), "<f8" if positions.dtype == torch.float64 else "<f4", PROPERTIES[3:]
    # Each value is written once: every further array as large as the file costs time for its pages.
    rows = np.zeros(n, dtype=[("positions", kind, 3), ("others", "<f4", len(others))])
    rows["positions"] = positions.numpy()
    _, colour, higher, opacity, scales, quats = np.split(rows["others"], np.cumsum(WIDTHS), axis=1)
    colour[:] = values["sh0"].reshape(n, 3).numpy()
    by_channel = higher.reshape(n, 3, HIGHER_COEFFICIENTS)
    by_channel[:, :, : values["shN"].shape[1]] = values["shN"].transpose(1, 2).numpy()
    opacity[:] = values["opacities"].reshape(n, 1).numpy()
    scales[:] = values["scales"].numpy()
    quats[:] = values["quats"].numpy()
    vertices = rows.view([*((name, kind) for name in PROPERTIES[:3]), *((name, "<f4") for name in others)])
    with write_aside(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(temporary))


def read_ply(path: str | Path) -> dict[str, Tensor]:
    """Read a 3DGS model of SH degree 0 to 3, raw values; normals are optional and ignored.

    Returns:
        `means [N, 3]`, `scales [N, 3]` (log), `quats [N, 4]` (wxyz, any length but 0), `opacities [N]` (logit),
        `sh0 [N, 1, 3]` and `shN [N, K - 1, 3]`, float32 on the CPU.

    Raises:
        MissingFileError: The file does not exist.
        InputError: The file is not a Gaussian PLY, truncated, empty, or has values that cannot be rendered.
    """
    return model_of(Path(path), read_vertices(Path(path)))


def read_points(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a point cloud: positions [M, 3] and colours [M, 3] uint8, grey if the file has no colours.

    Positions are float32, or float64 if float32 would lose precision.

    Raises:
        MissingFileError: The file does not exist.
        InputError: The file is not a PLY, truncated, lacks x, y and z, or has values that are not finite.
    """
    return points_of(Path(path), read_vertices(Path(path)))


def read_start(path: str | Path) -> tuple[tuple[np.ndarray, np.ndarray], dict[str, Tensor] | None]:
    """Read a start for training: positions and colours like `read_points`, and the Gaussians of a 3DGS model.

    Raises:
        MissingFileError: The file does not exist.
        InputError: The file is neither a point cloud nor a model, has fewer than four points, or is compressed and so
            rounded.
    """
    path = Path(path).expanduser()
    vertices = read_vertices(path, rounded=False)
    cloud = points_of(path, vertices)
    check_points(cloud[0], path)
    return cloud, model_of(path, vertices) if "f_dc_0" in vertices else None


def model_of(path: Path, vertices: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    """Return the Gaussians of `read_ply`."""
    count = sum(name.startswith("f_rest_") for name in vertices)
    if count not in F_REST_COUNTS:
        raise InputError(
            f"PLY {path} has {count} f_rest properties, expected one of {F_REST_COUNTS}; export it with "
            "spherical harmonics of degree 3 or less."
        )
    names = [n for n in PROPERTIES if n[0] != "n" and (not n.startswith("f_rest") or int(n[7:]) < count)]
    lacking = [name for name in names if name not in vertices]
    if lacking:
        raise InputError(f"PLY {path} is not a 3DGS model: it lacks {', '.join(lacking[:4])}; export it again.")
    table = columns(path, vertices, names, infinite=SATURATING)
    if not len(table):
        raise InputError(f"PLY {path} holds no Gaussians; export it again from a sound checkpoint.")
    means, sh0, higher, opacity, scales, quats = torch.from_numpy(table).split([3, 3, count, 1, 3, 4], dim=1)
    if (quats == 0).all(dim=1).any():
        raise InputError(f"PLY {path} holds rotations of length 0; export it again from a sound checkpoint.")
    exact = positions_of(vertices)
    splats = {
        "means": means.contiguous() if exact.dtype == np.float32 else torch.from_numpy(exact),
        "scales": scales.contiguous(),
        "quats": quats.contiguous(),
        "opacities": opacity[:, 0].contiguous(),
        "sh0": sh0[:, None, :].contiguous(),
        "shN": higher.reshape(len(higher), 3, count // 3).transpose(1, 2).contiguous(),
    }
    return renderable(splats, path)


def saturated(splats: Mapping[str, Tensor], path: str | Path) -> dict[str, Tensor]:
    """Replace infinite opacities and zero scales in raw parameters by finite numbers, and warn about their number.

    A saturated model has them: an opacity of 1 is infinite as a logit, and a flat Gaussian has a scale of e^-inf.
    """
    result = dict(splats)
    for name, low, high in (("opacities", -MAX_LOGIT, MAX_LOGIT), ("scales", MIN_LOG_SCALE, np.inf)):
        values = result[name]
        infinite = torch.isinf(values) & ((values < 0) | (high < np.inf))
        if bool(infinite.any()):
            log.warning("%s: %d infinite %s are read as finite numbers.", path, int(infinite.sum()), name)
            result[name] = torch.where(infinite, values.clamp(low, high), values)
    return result


def renderable(splats: Mapping[str, Tensor], path: str | Path) -> dict[str, Tensor]:
    """Return the result of `saturated`.

    Raises:
        InputError: Other values are not finite, or scales are too large. The message names `path`.
    """
    result = saturated(splats, path)
    if not all(bool(torch.isfinite(values).all()) for values in result.values()):
        raise InputError(f"{path} holds NaN or infinite values; export it again from a sound checkpoint.")
    if len(result["scales"]) and float(result["scales"].max()) > MAX_LOG_SCALE:
        raise InputError(f"{path} holds scales above e^{MAX_LOG_SCALE:g}: they must be logarithms.")
    return result


def points_of(path: Path, vertices: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and colours of `read_points`."""
    if not {"x", "y", "z"} <= set(vertices):
        raise InputError(f"PLY {path} has no vertices with x, y and z; give a point cloud.")
    columns(path, vertices, ["x", "y", "z"])  # finite
    positions = positions_of(vertices)
    return positions, colours_of(path, vertices)


def positions_of(vertices: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return positions [N, 3]: float64 if the file has float64 and float32 would lose precision, else float32."""
    table = np.stack([vertices[name].astype(np.float64) for name in ("x", "y", "z")], axis=1)
    short = table.astype(np.float32)
    return table if is_far(table) and (short != table).any() else short


def colours_of(path: Path, vertices: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return colours [M, 3] uint8 from columns of any known name and type; grey if there are no colours.

    Bytes are used unchanged, even bytes of a signed type. For other types, the largest value tells the range: up to 1
    for floats (or slightly more), else up to 255, else up to 65,535.
    """
    by_name = {name.lower(): values for name, values in vertices.items()}
    for name in PACKED_COLOURS:
        if name in by_name and by_name[name].dtype.itemsize == 4:
            bits = np.ascontiguousarray(by_name[name])
            bits = bits.view(bits.dtype.str[0] + "u4")
            return np.stack([bits >> shift & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)
    names = next((names for names in COLOURS if set(names) <= set(by_name)), None)
    if names is not None:
        by_name |= {name: by_name[name].view("u1") for name in names if by_name[name].dtype == np.int8}
        colours = columns(path, by_name, list(names))
        largest = float(colours.max(initial=0.0))
        kinds = {by_name[name].dtype for name in names}
        if any(kind.kind == "f" for kind in kinds) and largest <= BRIGHTEST:
            colours = colours * 255
        elif any(kind.itemsize > 1 for kind in kinds) and largest > 255.5:
            colours = colours / 257
        return np.rint(colours.clip(0, 255)).astype(np.uint8)
    if {"f_dc_0", "f_dc_1", "f_dc_2"} <= set(vertices):
        colours = colours_of_sh0(columns(path, vertices, ["f_dc_0", "f_dc_1", "f_dc_2"]))
        return np.rint(colours.clip(0, 1) * 255).astype(np.uint8)
    log.warning("%s has no colours (red, green and blue): its points are grey.", path)
    return np.full((len(vertices["x"]), 3), 128, dtype=np.uint8)


def read_vertices(path: Path, rounded: bool = True) -> dict[str, np.ndarray]:
    """Return the vertices' properties [N] by name. The header is checked before memory is allocated."""
    from plyfile import PlyData, PlyParseError

    check_header(path)
    try:
        content = PlyData.read(without_blank_lines(path))  # maps a binary file: else plyfile reads number by number
        elements: dict[str, dict[str, np.ndarray]] = {}
        for element in content.elements:
            if element.name in ("vertex", "chunk", "sh"):
                data = np.array(element.data)  # a copy: the file may be replaced or cut off later
                elements[element.name] = {prop.name: data[prop.name] for prop in element.properties}
        vertices = elements["vertex"]
        if is_compressed(vertices):
            if not rounded:
                raise InputError(
                    f"PLY {path} is compressed: its numbers are rounded to 8 to 11 bits. Start from the model it was "
                    f"made of, or run: {next_command('export', path, path.with_suffix('').with_suffix('.ply'))}."
                )
            return decompress(vertices, elements["chunk"], elements.get("sh", {}))
        return plain_names(vertices)
    except InputError:
        raise
    except (PlyParseError, KeyError, ValueError, TypeError, EOFError, MemoryError, OSError) as error:
        raise InputError(f"PLY {path} is damaged or not a PLY ({reason(error)}); export it again.") from error


def without_blank_lines(path: Path) -> str | io.BytesIO:
    """Return the input for plyfile: the path, or a text PLY without its blank lines, which plyfile refuses."""
    data = path.read_bytes() if is_text(path) else b""
    header, end, body = data.partition(b"end_header")
    lines = body.splitlines()
    if all(line.strip() for line in lines[1:]):  # the first is the rest of end_header's
        return str(path)
    kept = [line for line in lines[1:] if line.strip()]
    return io.BytesIO(b"\n".join([header.replace(b"\r\n", b"\n") + end, *kept]) + b"\n")


def is_text(path: Path) -> bool:
    """Whether a PLY says that it holds its numbers as text."""
    with open(path, "rb") as stream:
        words = [line.split() for line in stream.read(MAX_HEADER).partition(b"end_header")[0].splitlines()]
    return any(line[:2] == [b"format", b"ascii"] for line in words)


def plain_names(vertices: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return columns of a model by their own names: CloudCompare writes `scalar_f_dc_0`, or `scalar_scal_f_dc_0`."""
    result = dict(vertices)
    for name, values in vertices.items():
        plain = name.removeprefix("scalar_").removeprefix("scal_")
        if plain in PROPERTIES:
            result.setdefault(plain, values)
    return result


def check_header(path: Path) -> None:
    """Refuse counts that the file cannot hold: each value takes at least one byte, and vertices have no lists."""
    if os.path.isdir(path):
        raise InputError(f"PLY {path} is a folder; give the path of a PLY file.")
    if not os.path.isfile(path):
        raise MissingFileError(f"PLY {path} does not exist; give the path of a PLY file.")
    try:
        with open(path, "rb") as stream:
            size, head = os.fstat(stream.fileno()).st_size, stream.read(MAX_HEADER)
    except OSError as error:
        raise InputError(f"PLY {path} cannot be read ({reason(error)}).") from error
    header, found, _ = head.partition(b"end_header")
    if is_pointer(path):
        raise InputError(f"PLY {path} cannot be read: {HINT}.")
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
        raise InputError(
            f"PLY {path} is damaged: its header claims at least {needed:,} bytes, but it has {size:,}; export it again."
        )


def columns(
    path: Path, vertices: Mapping[str, np.ndarray], names: list[str], infinite: tuple[str, ...] = ()
) -> np.ndarray:
    """Return the named properties as a table [N, len(names)] float32. All but those in `infinite` must be finite."""
    with np.errstate(over="ignore"):
        table = np.stack([vertices[name].astype(np.float32) for name in names], axis=1)
    may_be = np.array([name in infinite for name in names])
    if not np.isfinite(table[:, ~may_be]).all() or np.isnan(table).any():
        raise InputError(f"PLY {path} holds NaN or infinite values; export it again from a sound checkpoint.")
    return table
