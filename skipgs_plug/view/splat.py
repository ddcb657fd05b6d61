"""Read .splat files (antimatter15, most web viewers): 32 bytes per Gaussian, colours do not change with direction.

Written from the description at github.com/antimatter15/splat. `gsplat.export_splats` writes such files.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.compressed_ply import logits
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.ply import renderable
from skipgs_plug.trainer.sh0 import sh0_of

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def read_splat(path: Path) -> dict[str, Tensor]:
    """Return the raw parameters of a .splat like `read_ply`, with `shN [N, 0, 3]`.

    Raises:
        InputError: The file is damaged or not a .splat.
    """
    data = path.read_bytes()
    if not data or len(data) % ROW.itemsize:
        raise InputError(
            f"{path} is damaged or not a .splat: its {len(data):,} bytes are not rows of {ROW.itemsize}; "
            "export it again."
        )
    rows = np.frombuffer(data, dtype=ROW)
    quats = (rows["quats"].astype(np.float32) - 128.0) / 128.0
    if not np.abs(quats).max(axis=1).all() or (rows["scales"] < 0).any():
        raise InputError(f"{path} is damaged or not a .splat: it holds rotations of length 0 or negative scales.")
    with np.errstate(divide="ignore"):
        scales = np.log(rows["scales"])
    values = {
        "means": rows["means"],
        "scales": scales,
        "quats": quats,
        "opacities": logits(rows["rgba"][:, 3] / 255.0),
        "sh0": sh0_of(rows["rgba"][:, :3] / 255.0)[:, None],
        "shN": np.zeros((len(rows), 0, 3)),
    }
    splats = {name: torch.from_numpy(np.array(value, dtype=np.float32)) for name, value in values.items()}
    return renderable(splats, path)
