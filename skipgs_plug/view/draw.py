"""Draw a model as a camera sees it, and colour depths."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.backend import Backend, single_precision
from skipgs_plug.trainer.ply import sh_degree
from skipgs_plug.view.model import Model

DEPTH_QUANTILES = (0.02, 0.98)  # ends of the colour scale: single far splats would take up all of it


class Painter:
    """Renders models of the raw parameters that a trainer holds.

    Args:
        backend: Rasterizer.
        background: Colour in [0, 1] behind the model.
        near_plane: Near clipping plane in scene units.
        antialiased: Whether the model was trained with antialiasing.
        far_plane: Far clipping plane in scene units, as in training.
    """

    def __init__(
        self,
        backend: Backend,
        background: tuple[float, float, float],
        near_plane: float,
        antialiased: bool,
        far_plane: float,
    ) -> None:
        self._backend = backend
        self._background = background
        self._near_plane, self._far_plane = near_plane, far_plane
        self._mode = "antialiased" if antialiased else "classic"

    @classmethod
    def of(cls, model: Model, backend: Backend) -> Painter:
        """Return a painter with the settings of the model's training."""
        settings = model.background, model.near_plane, model.antialiased, model.far_plane
        return cls(backend, *settings)

    @torch.no_grad()
    @single_precision()
    def draw(
        self,
        splats: Mapping[str, Tensor],
        viewmat: Tensor,  # [4, 4] of any float type
        K: Tensor,  # [3, 3], pixels
        width: int,
        height: int,
    ) -> tuple[Tensor, Tensor]:
        """Return colour [H, W, 3] in [0, 1] and expected depth [H, W] in scene units, 0 where the picture is empty."""
        device = self._backend.device
        raw = {name: tensor.detach().to(device) for name, tensor in splats.items()}
        background = torch.tensor([self._background], device=device) if any(self._background) else None
        with self._backend.exclusive_cores():
            image, _, _ = self._backend.rasterization(
                means=raw["means"],
                quats=raw["quats"],
                scales=torch.exp(raw["scales"]),
                opacities=torch.sigmoid(raw["opacities"]),
                colors=torch.cat([raw["sh0"], raw["shN"]], dim=1),
                viewmats=viewmat[None].to(device, torch.float32),
                Ks=K[None].to(device, torch.float32),
                width=width,
                height=height,
                near_plane=self._near_plane,
                far_plane=self._far_plane,
                sh_degree=sh_degree(raw["shN"].shape[1]),
                render_mode="RGB+ED",
                rasterize_mode=self._mode,
                backgrounds=background,
                packed=False,
            )
        return image[0, ..., :3].clamp(0, 1).cpu(), image[0, ..., 3].cpu()


def to_bytes(image: Tensor) -> np.ndarray:
    """Return an image [H, W, 3] in [0, 1] as uint8."""
    return (image.clamp(0, 1) * 255).round().byte().numpy()


def depth_range(depths: list[Tensor]) -> tuple[float, float]:
    """Return the range that holds 96 % of the depths in these maps [H, W]; 0 counts as empty."""
    known = torch.cat([depth[depth > 0] for depth in depths])
    if len(known) == 0:
        return 0.0, 1.0
    low, high = np.quantile(known.numpy(), DEPTH_QUANTILES)
    return float(low), float(max(high, low + 1e-6))


def colour_depth(depth: Tensor, limits: tuple[float, float]) -> np.ndarray:
    """Return depths [H, W] as colours [H, W, 3] uint8: red is near, blue is far, black is empty."""
    from matplotlib import colormaps

    low, high = limits
    nearness = ((high - depth) / (high - low)).clamp(0, 1).numpy()
    colours = (colormaps["turbo"](nearness)[..., :3] * 255).round().astype(np.uint8)
    colours[depth.numpy() <= 0] = 0
    return colours
