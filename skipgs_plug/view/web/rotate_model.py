"""Rotate and scale a model, with its quaternions and spherical harmonics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.ply import sh_degree

DIRECTIONS = 64  # directions that coefficients are fitted to; degree 3 has only 15 unknowns


def upright(up: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] that turns `up` to -y, which viewers expect of a PLY, and `ahead` to about z."""
    down = -up / np.linalg.norm(up)
    ahead = ahead - (ahead @ down) * down
    if np.linalg.norm(ahead) < 1e-6:
        ahead = np.cross(down, [1.0, 0.0, 0.0] if abs(down[0]) < 0.9 else [0.0, 1.0, 0.0])
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(down, ahead), down, ahead])


@torch.no_grad()
def rotated(splats: Mapping[str, Tensor], rotation: np.ndarray, unit: float) -> dict[str, Tensor]:
    """Return the raw parameters of the model, rotated by `rotation` [3, 3] and with lengths multiplied by `unit`."""
    from scipy.spatial.transform import Rotation

    matrix = torch.from_numpy(rotation).double()
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float32)
    higher = splats["shN"].float()
    if higher.shape[1]:
        higher = torch.einsum("ij,njc->nic", rotated_harmonics(matrix, higher.shape[1]).float(), higher)
    return {
        "means": (splats["means"].double() @ matrix.T * unit).float(),
        "scales": splats["scales"].float() + float(np.log(unit)),
        "quats": splats["quats"].float() @ left.T,
        "opacities": splats["opacities"].float(),
        "sh0": splats["sh0"].float(),
        "shN": higher,
    }


def rotated_harmonics(rotation: Tensor, k: int) -> Tensor:
    """Return the matrix [K, K] that turns K coefficients beyond the constant one, by a rotation [3, 3], float64."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(DIRECTIONS, 3, generator=generator, dtype=torch.float64)
    # The colour of the turned model along d is the original colour along the direction that was turned to d.
    return torch.linalg.lstsq(basis(directions, k), basis(directions @ rotation, k)).solution


def basis(directions: Tensor, k: int) -> Tensor:
    """Return the K functions beyond the constant one along directions [M, 3], as [M, K]."""
    from skipgs_plug.fallback_raster import spherical_harmonics

    ones = torch.eye(k + 1, dtype=directions.dtype)[1:, :, None].expand(k, k + 1, 3)
    columns = [
        spherical_harmonics(sh_degree(k), directions, one.expand(len(directions), k + 1, 3))[:, 0] for one in ones
    ]
    return torch.stack(columns, dim=1)
