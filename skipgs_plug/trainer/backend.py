"""Rasterizer, loss and optimizers of a trainer: gsplat and torch on CUDA, this package's own on the CPU."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from skipgs_plug.install import install_command
from skipgs_plug.trainer.errors import InputError

Optimizers = Mapping[str, torch.optim.Optimizer]  # keys: names of the parameters from `create_splats`


@dataclass(frozen=True)
class Backend:
    """A renderer with gsplat's `rasterization` signature, and the loss and optimizers that suit its device.

    This class suits gsplat. `CpuBackend` suits the rasterizer of this package.
    """

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
        optimizers: Optimizers | None = None,
        **options: Any,
    ) -> tuple[Tensor, dict[str, Any]]:
        """Render raw parameters, with the names of `create_splats`, into one camera.

        Args:
            splats: Logarithms of scales, logits of opacities, SH coefficients in two parts.
            viewmat: World to camera, of any float type.
            K: Intrinsics [3, 3], pixels.
            background: Colour behind the scene; None for black, which needs no compositing.
            antialiased: Compensate opacities for the blur.
            with_rows: Whether the dictionary must hold rows of Gaussians.
            optimizers: Optimizers of the parameters, which may lag behind for Gaussians that no view showed; None if
                all parameters are up to date.
            options: `width height sh_degree near_plane far_plane absgrad` of `rasterization`.

        Returns:
            Image [H, W, 3] and the dictionary of `rasterization`.
        """
        viewmat, K = (matrix.to(self.device, torch.float32) for matrix in (viewmat, K))
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

    def create_adam(self, name: str, param: nn.Parameter, rate: float, eps: float) -> torch.optim.Optimizer:
        """Return an Adam for one parameter; its group is called `name`."""
        return torch.optim.Adam([{"params": [param], "lr": rate, "name": name}], eps=eps, fused=True)

    def catch_up(self, optimizers: Optimizers) -> None:
        """Bring Gaussians outside the last views up to date, before other code reads parameters or moments."""

    def release_memory(self) -> None:
        """Return memory that is kept for the next iteration, before other code needs a lot."""

    @contextmanager
    def exclusive_cores(self) -> Iterator[None]:
        """Limit torch to one thread inside the block if the rasterizer has threads of its own.

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


class CpuBackend(Backend):
    """The CPU rasterizer, which takes raw parameters and touches visible rows only.

    Its dictionary has a row per visible Gaussian, like gsplat's packed mode. Its Adam runs on all cores. The Adam of
    `shN`, which is three quarters of all numbers, updates only Gaussians that views show.
    """

    def render(
        self,
        splats: Mapping[str, Tensor] | nn.ParameterDict,
        viewmat: Tensor,  # [4, 4]
        K: Tensor,  # [3, 3]
        background: Tensor | None,  # [3]
        antialiased: bool = False,
        with_rows: bool = True,
        optimizers: Optimizers | None = None,
        **options: Any,
    ) -> tuple[Tensor, dict[str, Any]]:
        from skipgs_plug.fallback_raster import LazyAdam, rasterize_splats

        behind = None if optimizers is None else optimizers.get("shN")
        if isinstance(behind, LazyAdam):
            options["lazy"] = behind
        viewmat, K = (matrix.to(self.device, torch.float32) for matrix in (viewmat, K))
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

    def create_adam(self, name: str, param: nn.Parameter, rate: float, eps: float) -> torch.optim.Optimizer:
        from skipgs_plug.fallback_raster import Adam, LazyAdam

        kind = LazyAdam if name == "shN" and param.numel() else Adam
        return kind([{"params": [param], "lr": rate, "name": name}], eps=eps)

    def catch_up(self, optimizers: Optimizers) -> None:
        from skipgs_plug.fallback_raster import LazyAdam

        for optimizer in optimizers.values():
            if isinstance(optimizer, LazyAdam):
                optimizer.catch_up()

    def release_memory(self) -> None:
        from skipgs_plug.fallback_raster import release_memory

        release_memory()


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
    """Return the backend called "gsplat" or "warp"; "auto" is gsplat if CUDA works, else warp.

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
    from skipgs_plug.fallback_raster import l1_ssim_loss, rasterization

    # Warp itself is imported with the first kernel, on a spare thread, because it takes long.
    if importlib.util.find_spec("warp") is None:
        raise InputError(f"Backend warp needs NVIDIA Warp, which is not installed; run: {install_command()}.")
    return CpuBackend("warp", torch.device("cpu"), rasterization, l1_ssim_loss)
