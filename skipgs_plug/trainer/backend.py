"""Which rasterizer and loss a trainer runs on: gsplat on CUDA, Warp on CPU, one name for both."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from skipgs_plug.install import install_command
from skipgs_plug.trainer.errors import InputError


@dataclass(frozen=True)
class Backend:
    """A renderer with gsplat's `rasterization` signature, and the loss that suits its device."""

    name: str
    device: torch.device
    rasterization: Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
    loss: Callable[[Tensor, Tensor, float], Tensor]  # (image, target [..., H, W, C], also uint8; ssim_lambda) -> scalar

    def render(
        self,
        splats: Mapping[str, Tensor] | nn.ParameterDict,
        viewmat: Tensor,  # [4, 4]
        K: Tensor,  # [3, 3]
        background: Tensor | None,  # [3]
        antialiased: bool = False,
        with_rows: bool = True,
        **options: Any,
    ) -> tuple[Tensor, dict[str, Any]]:
        """Render raw parameters, as `create_splats` names them, into one camera.

        The CPU rasterizer takes them as they are and touches only rows that are visible; its dictionary has a row for
        each of these, as gsplat's packed mode.

        Args:
            splats: logarithms of scales, logits of opacities, SH coefficients in two parts.
            viewmat: world to camera, of any float type.
            K: Intrinsics [3, 3], pixels.
            background: colour behind everything; None for black, which needs no compositing.
            antialiased: compensate opacities for the blur.
            with_rows: whether the dictionary has to hold rows of Gaussians.
            options: `width height sh_degree near_plane far_plane absgrad` of `rasterization`, and
                `lazy` of `rasterize_splats` on the CPU.

        Returns:
            Image [H, W, 3] and the dictionary of `rasterization`.
        """
        viewmat, K = (matrix.to(self.device, torch.float32) for matrix in (viewmat, K))
        if self.name == "warp":
            from skipgs_plug.fallback_raster import rasterize_splats

            image, _, info = rasterize_splats(
                splats["means"],
                splats["quats"],
                splats["scales"],
                splats["opacities"],
                splats["sh0"],
                splats["shN"],
                viewmat,
                K,
                background=background,
                antialiased=antialiased,
                with_rows=with_rows,
                **options,
            )
            return image, info
        images, _, info = self.rasterization(
            means=splats["means"],
            quats=splats["quats"],
            scales=torch.exp(splats["scales"]),
            opacities=torch.sigmoid(splats["opacities"]),
            colors=torch.cat([splats["sh0"], splats["shN"]], dim=1),
            viewmats=viewmat[None],
            Ks=K[None],
            packed=False,
            rasterize_mode="antialiased" if antialiased else "classic",
            backgrounds=None if background is None else background[None],
            **options,
        )
        return images[0], info

    @contextmanager
    def exclusive_cores(self) -> Iterator[None]:
        """Keep torch to one thread inside the block where the rasterizer has threads of its own.

        torch's idle OpenMP threads spin for a while after each operation. They take the cores from the rasterizer:
        on two cores with another process running, iterations were five times slower.
        """
        before = torch.get_num_threads()
        if self.device.type == "cpu":
            torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(before)


@contextmanager
def single_precision() -> Iterator[None]:
    """Make float32 the default dtype inside the block, whatever the process has chosen.

    Parameters and kernels are float32, but gsplat's strategies create tensors of the default dtype.
    """
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def resolve_backend(name: str = "auto") -> Backend:
    """Return the backend called "gsplat" or "warp"; "auto" takes gsplat where CUDA works, else warp.

    Raises:
        InputError: The backend cannot run here; the message names the missing part.
    """
    if name == "auto":
        name = "gsplat" if torch.cuda.is_available() and _has_gsplat() else "warp"
    if name == "gsplat":
        return _gsplat_backend()
    if name == "warp":
        return _warp_backend()
    raise InputError(f"Backend {name!r} is unknown; choose auto, gsplat or warp.")


def _has_gsplat() -> bool:
    try:
        import gsplat  # noqa: F401
    except ImportError:
        return False
    return True


def _gsplat_backend() -> Backend:
    from skipgs_plug.trainer.loss import l1_ssim_loss

    if not torch.cuda.is_available():
        raise InputError("Backend gsplat needs a CUDA device and torch sees none; use --backend warp on the CPU.")
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise InputError(f"Backend gsplat cannot be imported ({error}); run: {install_command()}.") from error
    return Backend("gsplat", torch.device("cuda"), rasterization, l1_ssim_loss)


def _warp_backend() -> Backend:
    try:
        from skipgs_plug.fallback_raster import l1_ssim_loss, rasterization
    except ImportError as error:
        raise InputError(f"Backend warp cannot be imported ({error}); run: {install_command()}.") from error
    return Backend("warp", torch.device("cpu"), rasterization, l1_ssim_loss)
