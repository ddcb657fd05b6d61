"""The 62-property INRIA PLY, in the coordinates of the dataset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.errors import InputError, MissingFileError
from skipgs_plug.trainer.files import write_aside

REST = 15  # coefficients of SH degrees 1 to 3
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
    """Return `means scales quats opacities sh0 shN` of a 62- or 59-property PLY, raw values.

    Raises:
        MissingFileError: no such file.
        InputError: not a PLY, truncated, not a Gaussian PLY, or with NaN or infinite values.
    """
    from plyfile import PlyData, PlyParseError

    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"PLY {path} does not exist; give the path of a point_cloud_*.ply.")
    try:
        vertices = PlyData.read(str(path), mmap=False)["vertex"]
        needed = [name for name in PROPERTIES if name not in ("nx", "ny", "nz")]
        table = np.stack([np.asarray(vertices[name], dtype=np.float32) for name in needed], axis=1)
    except (PlyParseError, KeyError, ValueError, EOFError, UnicodeDecodeError) as error:
        raise InputError(f"PLY {path} is damaged or not a 3DGS model ({error}); export it again.") from error
    if not np.isfinite(table).all():
        raise InputError(f"PLY {path} holds NaN or infinite values; export it again from a sound checkpoint.")
    means, sh0, rest, opacity, scales, quats = torch.from_numpy(table).split([3, 3, 3 * REST, 1, 3, 4], dim=1)
    return {
        "means": means,
        "scales": scales,
        "quats": quats,
        "opacities": opacity[:, 0],
        "sh0": sh0[:, None, :],
        "shN": rest.reshape(-1, 3, REST).transpose(1, 2).contiguous(),
    }
