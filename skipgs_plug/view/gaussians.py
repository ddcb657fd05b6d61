"""Raw parameters of a model in the form that viser draws."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.sh0 import colours_of_sh0

HALF_MAX = 65_504.0  # largest float16: viser sends covariances in half precision


class Gaussians(NamedTuple):
    """Arguments of viser's `add_gaussian_splats` and `set_gaussians`."""

    centers: np.ndarray  # [N, 3]
    covariances: np.ndarray  # [N, 3, 3]
    rgbs: np.ndarray  # [N, 3] in [0, 1], the colour that does not depend on direction
    opacities: np.ndarray  # [N, 1]


@torch.no_grad()
def to_gaussians(splats: Mapping[str, Tensor], unit: float) -> Gaussians:
    """Return the Gaussians with lengths multiplied by `unit`."""
    raw = {name: splats[name].detach().cpu() for name in ("means", "quats", "scales", "opacities", "sh0")}
    w, x, y, z = torch.nn.functional.normalize(raw["quats"], dim=1).unbind(1)
    rotations = torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        dim=1,
    ).reshape(-1, 3, 3)
    halves = rotations * (torch.exp(raw["scales"]) * unit)[:, None, :]
    return Gaussians(
        (raw["means"] * unit).numpy(),
        (halves @ halves.mT).clamp(-HALF_MAX, HALF_MAX).numpy(),
        colours_of_sh0(raw["sh0"][:, 0]).clamp(0, 1).numpy(),
        torch.sigmoid(raw["opacities"])[:, None].numpy(),
    )
