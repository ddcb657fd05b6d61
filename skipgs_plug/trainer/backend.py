"""Which rasterizer and loss a trainer runs on: gsplat on CUDA, Warp on CPU, one name for both."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from skipgs_plug.install import install_command
from skipgs_plug.trainer.errors import InputError


@dataclass(frozen=True)
class Backend:
    """A renderer with gsplat's `rasterization` signature, and the loss that suits its device."""

    name: str
    device: torch.device
    rasterization: Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
    loss: Callable[[Tensor, Tensor, float], Tensor]  # (image, target [..., H, W, C], ssim_lambda) -> scalar

    def sh_colors(self, sh0: Tensor, shN: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Return SH coefficients [N, 1, 3] and [N, K - 1, 3] as `rasterization` takes them.

        The CPU rasterizer reads the two as they are; joining them costs more than evaluating them.
        """
        return (sh0, shN) if self.name == "warp" else torch.cat([sh0, shN], dim=1)

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


def resolve_backend(name: str = "auto") -> Backend:
    """Return the backend called "gsplat" or "warp"; "auto" takes gsplat where CUDA works, else warp.

    Raises:
        InputError: the backend cannot run here; the sentence says what is missing.
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
