"""The 3DGS loss, (1 - w) L1 + w (1 - SSIM). One kernel computes its value and its gradient.

SSIM (Wang et al. 2004) uses an 11x11 Gaussian window of sigma 1.5 pixels and the constants C1 = 0.01^2 and C2 = 0.03^2.
In terms of the difference d = x - y of the images, with means m, variances v and covariance c in a window,

    luminance  1 - (2 m_x m_y + C1) / (m_x^2 + m_y^2 + C1) = m_d^2 / (m_x^2 + m_y^2 + C1)
    structure  1 - (2 c + C2) / (v_x + v_y + C2)           = v_d   / (v_x + v_y + C2)

so that 1 - SSIM and its gradient are computed from small numbers and not as differences of large ones. Each tile also
subtracts its mean before it squares, because E[x^2] - E[x]^2 loses digits in float32 where an image is bright and flat.
The terms of the gradient use the shifted x and d for the same reason: where both images are flat, terms of unshifted
values would be thousands of times larger than their sum.

Images stay channels-last, as the rasterizer returns them: a blur along a row with C channels is a blur with stride C
over a flat row. A tile is at most 256 floats wide and 128 rows high. It is processed once for value and gradient. Rows
that later windows need stay in two ring buffers in the first two caches, and four rows at a time are blurred
vertically, which reads most numbers once. Each tile computes the values beyond its borders that it needs itself. That
is a fifth more work, but costs less than writing them for a second pass, and no core reads data that another one wrote.
"""

import math
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..runtime.arguments import as_kernels_read
from ..runtime.buffers import floats
from ..runtime.constants import LOSS_TILE_ROWS, LOSS_TILE_VECTORS, MAX_LOSS_CHANNELS, SSIM_WINDOW, TILE_LOSS_FLOATS
from ..runtime.function_modes import without_function_modes
from ..runtime.launch import Worker, worker
from ..runtime.parameters import ArrayKind, ByteArray, FloatArray, FloatOutput

# Most numbers (pixels times channels) in a row of an image: kernels compute columns in float32, which is exact up to
# 2^24.
MAX_ROW_NUMBERS = 2**24


# An array of records, whose fields are defined in `kernels/loss_tiles.h`.
TileLossOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.float32, "struct TileLoss")]


class ImageSize(NamedTuple):
    """Size of a batch of images."""

    images: int
    height: int
    width: int
    channels: int


class LossWeights(NamedTuple):
    """Weights of |image - target| and of 1 - SSIM of each element in the loss."""

    l1: float
    ssim: float


def _loss_tiles(name: str, pixels: Any) -> Worker[...]:
    @worker(file="loss_tiles.h", items="tiles", grain="1", name=name)
    def loss_tiles(
        *,
        image: Annotated[FloatArray, "size.images, size.height, size.width, size.channels"],
        target: Annotated[pixels, "size.images, size.height, size.width, size.channels"],
        gradient: Annotated[FloatOutput, "size.images if with_gradient else 0, size.height, size.width, size.channels"],
        sums: Annotated[TileLossOutput, "tiles, TILE_LOSS_FLOATS"],
        size: ImageSize,
        weights: LossWeights,
        tiles: int,
        valid: int,
        with_gradient: int,
    ) -> None: ...

    return loss_tiles


PHOTO_DTYPE = torch.uint8  # dtype in which photographs are kept: a quarter of the memory of float32
_LOSS_TILES = {
    torch.float32: _loss_tiles("loss_tiles", FloatArray),
    PHOTO_DTYPE: _loss_tiles("loss_tiles_bytes", ByteArray),
}


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_lambda: float, valid: bool) -> Tensor:  # type: ignore[override]
        height, width, channels = image.shape[-3:]
        images = image.numel() // (height * width * channels)
        size = ImageSize(images, height, width, channels)
        with_gradient = ctx.needs_input_grad[0]
        tiles = images * -(-height // LOSS_TILE_ROWS) * -(-width * channels // (16 * LOSS_TILE_VECTORS))
        border = SSIM_WINDOW - 1 if valid else 0
        windows = images * (height - border) * (width - border) * channels
        weights = LossWeights((1.0 - ssim_lambda) / image.numel(), ssim_lambda / windows)
        gradient, sums = floats(*image.shape) if with_gradient else floats(0), floats(tiles, TILE_LOSS_FLOATS)
        _LOSS_TILES[target.dtype](
            image=image,
            target=target,
            gradient=gradient,
            sums=sums,
            size=size,
            weights=weights,
            tiles=tiles,
            valid=int(valid),
            with_gradient=int(with_gradient),
        )
        ctx.save_for_backward(gradient)
        # Each tile was summed in float32. Adding tiles in float64 in a fixed order keeps the last digits of the mean.
        l1, unlike = map(math.fsum, zip(*sums.tolist(), strict=True))
        return torch.tensor(weights.l1 * l1 + weights.ssim * unlike, dtype=torch.float32, device="cpu")

    @staticmethod
    @without_function_modes
    @once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> Any:  # type: ignore[override]
        (gradient,) = ctx.saved_tensors
        return gradient if v_loss.item() == 1.0 else v_loss * gradient, None, None, None


def l1_ssim_loss(
    image: Tensor,  # [..., H, W, C]
    target: Tensor,  # [..., H, W, C]
    ssim_lambda: float = 0.2,
    padding: Literal["same", "valid"] = "same",
) -> Tensor:
    """Compute the 3DGS training loss (Kerbl et al. 2023, eq. 7) in one kernel, in float32 on all cores.

    The loss is (1 - ssim_lambda) mean |image - target| + ssim_lambda (1 - mean SSIM). It is bit-equal for any number of
    threads. It is differentiable in `image`; its gradient is computed together with the value, so the backward pass is
    free.

    Args:
        image: Rendered image [..., H, W, C], usually in [0, 1].
        target: Photograph of the same shape, float, or uint8 for values in [0, 255] that are divided by 255.
        ssim_lambda: Weight of the SSIM term.
        padding: "same" continues the images with black (Inria, and the default of fused_ssim). "valid" averages SSIM
            over windows inside the image only (gsplat).

    Returns:
        Scalar.

    Raises:
        ValueError: Shapes differ, there are more than 32 channels, a row has more than 2^24 numbers, an image is too
            small for "valid", a tensor has another dtype or is not on the CPU, or `target` requires a gradient.

    Example:
        A grey image against a black photograph.

        >>> import torch
        >>> image = torch.full((32, 32, 3), 0.5, requires_grad=True)
        >>> loss = l1_ssim_loss(image, torch.zeros(32, 32, 3))
        >>> loss.backward()
        >>> round(loss.item(), 3), image.grad.shape
        (0.6, torch.Size([32, 32, 3]))
    """
    in_bytes = target.dtype is torch.uint8
    for name, tensor, kinds, fits in (
        ("image", image, "float", image.is_floating_point()),
        ("target", target, "float or uint8", target.is_floating_point() or in_bytes),
    ):
        if not fits or tensor.device.type != "cpu":
            raise ValueError(f"{name} must be a {kinds} tensor on the CPU, got {tensor.dtype} on {tensor.device}.")
    if image.shape != target.shape or image.dim() < 3 or image.numel() == 0:
        raise ValueError(
            f"image and target must have one shape [..., H, W, C], got {list(image.shape)} and {list(target.shape)}."
        )
    if image.shape[-1] > MAX_LOSS_CHANNELS:
        raise ValueError(
            f"images may have at most {MAX_LOSS_CHANNELS} channels, got {image.shape[-1]}; are they [H, W, C]?"
        )
    if image.shape[-2] * image.shape[-1] > MAX_ROW_NUMBERS:
        raise ValueError(
            f"a row of an image may have at most {MAX_ROW_NUMBERS} numbers, got {image.shape[-2]} pixels of "
            f"{image.shape[-1]} channels."
        )
    if padding not in ("same", "valid"):
        raise ValueError(f"padding must be 'same' or 'valid', got {padding!r}.")
    if padding == "valid" and min(image.shape[-3:-1]) < SSIM_WINDOW:
        raise ValueError(
            f"padding='valid' needs images of at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, got "
            f"{image.shape[-2]}x{image.shape[-3]}; use padding='same'."
        )
    if target.requires_grad:
        raise ValueError("l1_ssim_loss is differentiable in image only: pass target.detach().")
    (rendered,) = as_kernels_read(image)
    (photograph,) = [target.contiguous()] if in_bytes else as_kernels_read(target)
    return _L1Ssim.apply(rendered, photograph, ssim_lambda, padding == "valid").to(image.dtype)
