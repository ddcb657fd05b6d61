"""The 3DGS loss, (1 - w) L1 + w (1 - SSIM), value and gradient in one go.

SSIM (Wang et al. 2004) with an 11x11 Gaussian window of sigma 1.5 and the constants 0.01^2 and 0.03^2. In terms of
the difference d = x - y of the images, with means m, variances v and covariance c inside a window,

    luminance  1 - (2 m_x m_y + C1) / (m_x^2 + m_y^2 + C1) = m_d^2 / (m_x^2 + m_y^2 + C1)
    structure  1 - (2 c + C2) / (v_x + v_y + C2)           = v_d   / (v_x + v_y + C2)

so that 1 - SSIM and its gradient come out of small numbers instead of differences of large ones. Every tile also
subtracts a row of its own before it squares, because E[x^2] - E[x]^2 loses digits in float32 where an image is
bright and flat. For the same reason the parts of the gradient count x from 0.5 and d from its mean: where both images
are flat they are thousands of times larger than their sum.

Images stay channels-last, as the rasterizer returns them: a blur along a row is a blur with stride C over a flat
row. A tile is 128 floats wide and 32 rows high; a ring of its last 11 blurred rows stays in the first-level cache.
Two passes: value and the slopes of SSIM, then the blur of the slopes, which is the gradient. Counted, that is about
370 cycles per 16 floats, 3.6 ms for 504x378 pixels on one core of 3.6 GHz; measured (processor time) 4.5 to 5.2 ms.
"""

from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .launch import FloatArray, scratch, worker

WINDOW = 11
MAX_CHANNELS = 32  # of the buffers that extend a row beyond the image

# Tiles as both passes see them. A row of slopes has room for the window on either side.
_TILES = """
const float w[11] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601172f,
                     0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
const int span = width * channels, vectors = (span + 15) / 16, reach = 5 * channels;
const int margin = (reach + 15) / 16 * 16, pitch = vectors * 16 + 2 * margin;
const int bands = (height + 31) / 32, chunks = (vectors + 7) / 8;
"""
_TILE = """
    const int top = item / chunks % bands * 32, bottom = smaller(top + 32, height);
    const int first_vector = item % chunks * 8, last_vector = smaller(first_vector + 8, vectors);
    const long long start = (long long)(item / chunks / bands) * height;  // first row of this image
    const float *x = image + start * span, *y = target + start * span;
    const float* offset = offsets + (long long)(item / chunks / bands) * 16 * vectors;
    // Floats `i` to `i + 15` of a row that may end before.
    auto piece = [&](const float* row, int i) -> v16 {
        if (i + 16 <= span) return load(row + i);
        v16 a = (v16)0.0f;
        for (int j = 0; i + j < span; ++j) a[j] = row[i + j];
        return a;
    };
"""
_ITEMS = "images * ((height + 31) / 32) * (((width * channels + 15) / 16 + 7) / 8)"


def _tiles(images: int, height: int, width: int, channels: int) -> int:
    return images * -(-height // 32) * -(-width * channels // 128)


def _pitch(width: int, channels: int) -> int:
    return -(-width * channels // 16) * 16 + 2 * (-(-5 * channels // 16) * 16)


def _offsets(image: Tensor, target: Tensor, images: int, height: int, width: int, channels: int) -> Tensor:
    """The mean difference of each channel, along a row of floats; every eighth pixel tells it well enough."""
    some_x, some_y = (t.view(images, height, width, channels)[:, ::8, ::8] for t in (image, target))
    return (some_x - some_y).mean((1, 2)).repeat(1, width + 16)[:, : -(-width * channels // 16) * 16].contiguous()


@worker(
    _TILES
    + """
for (int item = first; item < last; ++item) {
"""
    + _TILE
    + """
    const long long middle = (long long)(top + bottom) / 2 * span;
    v16 l1 = (v16)0.0f, unlike = (v16)0.0f;
    // The last 11 rows, blurred along themselves: x, d, x^2 + y^2 and d^2, all less the shifts.
    alignas(64) v16 ring[11][8][4];
    for (int row = top - 5; row < bottom + 5; ++row) {
        for (int vector = first_vector; vector < last_vector; ++vector) {
            const int i = 16 * vector;
            const v16 shift_x = piece(x + middle, i), shift_y = piece(y + middle, i), shift_d = shift_x - shift_y;
            v16* out = ring[(row + 11) % 11][vector - first_vector];
            if (row < 0 || row >= height) {  // black
                out[0] = -shift_x;
                out[1] = -shift_d;
                out[2] = shift_x * shift_x + shift_y * shift_y;
                out[3] = shift_d * shift_d;
                continue;
            }
            const float *px = x + (long long)row * span + i - reach, *py = y + (long long)row * span + i - reach;
            float edge_x[16 + 10 * 32], edge_y[16 + 10 * 32];
            if (i < reach || i + 16 + reach > span) {
                for (int j = 0; j < 16 + 2 * reach; ++j) {
                    const bool inside = i - reach + j >= 0 && i - reach + j < span;
                    edge_x[j] = inside ? px[j] : 0.0f;
                    edge_y[j] = inside ? py[j] : 0.0f;
                }
                px = edge_x;
                py = edge_y;
            }
            if (row >= top && row < bottom) l1 += vabs(load(px + reach) - load(py + reach));
            v16 mean_x = (v16)0.0f, mean_d = mean_x, squares = mean_x, differences = mean_x;
            for (int k = 0; k < 11; ++k) {
                const v16 a = load(px + k * channels) - shift_x, b = load(py + k * channels) - shift_y, d = a - b;
                const v16 wa = w[k] * a, wb = w[k] * b, wd = w[k] * d;
                mean_x += wa;
                mean_d += wd;
                squares += wa * a;
                squares += wb * b;
                differences += wd * d;
            }
            out[0] = mean_x;
            out[1] = mean_d;
            out[2] = squares;
            out[3] = differences;
        }
        const int centre = row - 5;
        if (centre < top) continue;
        const v16* line[11];
        for (int k = 0; k < 11; ++k) line[k] = ring[(row + 1 + k) % 11][0];
        const bool row_counts = !valid || (centre >= 5 && centre < height - 5);
        for (int vector = first_vector; vector < last_vector; ++vector) {
            const int i = 16 * vector;
            const v16 shift_x = piece(x + middle, i), shift_d = shift_x - piece(y + middle, i);
            v16 blur[4] = {(v16)0.0f, (v16)0.0f, (v16)0.0f, (v16)0.0f};
            for (int k = 0; k < 11; ++k)
                for (int m = 0; m < 4; ++m) blur[m] += w[k] * line[k][4 * (vector - first_vector) + m];
            const v16 column = lane + (float)i;
            const i16 counts = (column < (float)(valid ? span - reach : span)) & (column >= (float)(valid ? reach : 0))
                             & (i16)(row_counts ? -1 : 0);
            const v16 mean_x = blur[0] + shift_x, mean_d = blur[1] + shift_d, mean_y = mean_x - mean_d;
            const v16 shifted_y = blur[0] - blur[1];
            const v16 variances = vmax(blur[2] - blur[0] * blur[0] - shifted_y * shifted_y, (v16)0.0f);
            const v16 variance_d = vmax(blur[3] - blur[1] * blur[1], (v16)0.0f);
            const v16 b1 = 1.0f / (mean_x * mean_x + mean_y * mean_y + 1e-4f), b2 = 1.0f / (variances + 9e-4f);
            const v16 luminance = mean_d * mean_d * b1, structure = variance_d * b2;
            unlike += counts ? luminance + (1.0f - luminance) * structure : (v16)0.0f;
            if (!with_gradient) continue;
            // The gradient of 1 - SSIM is blur(rest) + (d - offset) blur(slope_d) + (x - 0.5) blur(slope_x).
            const v16 slope_d = 2.0f * b2 * (1.0f - luminance), slope_x = -structure * slope_d;
            const v16 rest = 2.0f * (1.0f - structure) * b1 * mean_d * (1.0f - mean_x * mean_d * b1)
                           - (mean_d - load(offset + i)) * slope_d - (mean_x - 0.5f) * slope_x;
            float* out = slopes + (start + centre) * 3 * pitch + margin + i;
            store(out, counts ? rest : (v16)0.0f);
            store(out + pitch, counts ? slope_d : (v16)0.0f);
            store(out + 2 * pitch, counts ? slope_x : (v16)0.0f);
            for (int m = 0; m < 3; ++m) {
                for (int j = 0; vector == 0 && j < margin; j += 16) store(out + m * pitch - margin + j, (v16)0.0f);
                for (int j = 16; vector == vectors - 1 && j < 16 + margin; j += 16)
                    store(out + m * pitch + j, (v16)0.0f);
            }
        }
    }
    sums[2 * item] = sum(l1);
    sums[2 * item + 1] = sum(unlike);
}
""",
    items=_ITEMS,
    grain=1,
)
def compare_tiles(
    image: FloatArray,  # [B, H, W, C]
    target: FloatArray,  # [B, H, W, C]
    offsets: FloatArray,  # [B, 16 ceil(W C / 16)], a value of d for every float of a row
    slopes: FloatArray,  # out [B, H, 3, pitch], only written with_gradient
    sums: FloatArray,  # out [tiles, 2], |image - target| and 1 - SSIM summed over each tile
    images: int,  # B
    height: int,
    width: int,
    channels: int,
    valid: int,
    with_gradient: int,
) -> None: ...


@worker(
    _TILES
    + """
for (int item = first; item < last; ++item) {
"""
    + _TILE
    + """
    alignas(64) v16 ring[11][8][3];
    for (int row = top - 5; row < bottom + 5; ++row) {
        for (int vector = first_vector; vector < last_vector; ++vector) {
            v16* out = ring[(row + 11) % 11][vector - first_vector];
            const float* from = slopes + (start + row) * 3 * pitch + margin + 16 * vector - reach;
            v16 v[3] = {(v16)0.0f, (v16)0.0f, (v16)0.0f};
            if (row >= 0 && row < height)
                for (int k = 0; k < 11; ++k)
                    for (int m = 0; m < 3; ++m) v[m] += w[k] * load(from + m * pitch + k * channels);
            for (int m = 0; m < 3; ++m) out[m] = v[m];
        }
        const int centre = row - 5;
        if (centre < top) continue;
        const v16* line[11];
        for (int k = 0; k < 11; ++k) line[k] = ring[(row + 1 + k) % 11][0];
        for (int vector = first_vector; vector < last_vector; ++vector) {
            const int i = 16 * vector;
            v16 blur[3] = {(v16)0.0f, (v16)0.0f, (v16)0.0f};
            for (int k = 0; k < 11; ++k)
                for (int m = 0; m < 3; ++m) blur[m] += w[k] * line[k][3 * (vector - first_vector) + m];
            const long long row_start = (long long)centre * span;
            const v16 a = piece(x + row_start, i), d = a - piece(y + row_start, i);
            const v16 sign = d > 0.0f ? (v16)1.0f : (d < 0.0f ? (v16)-1.0f : (v16)0.0f);
            const v16 v_unlike = blur[0] + (d - load(offset + i)) * blur[1] + (a - 0.5f) * blur[2];
            const v16 v = l1_weight * sign + ssim_weight * v_unlike;
            float* out = gradient + start * span + row_start + i;
            if (i + 16 <= span) store(out, v);
            else for (int j = 0; i + j < span; ++j) out[j] = v[j];
        }
    }
}
""",
    items=_ITEMS,
    grain=1,
)
def gradient_tiles(
    image: FloatArray,  # [B, H, W, C]
    target: FloatArray,  # [B, H, W, C]
    offsets: FloatArray,  # [B, 16 ceil(W C / 16)], a value of d for every float of a row
    slopes: FloatArray,  # [B, H, 3, pitch]
    gradient: FloatArray,  # out [B, H, W, C]
    images: int,
    height: int,
    width: int,
    channels: int,
    l1_weight: float,
    ssim_weight: float,
) -> None: ...


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_lambda: float, valid: bool) -> Tensor:  # type: ignore[override]
        height, width, channels = image.shape[-3:]
        images = image.numel() // (height * width * channels)
        size = (images, height, width, channels)
        with_gradient = ctx.needs_input_grad[0]
        slopes = scratch("ssim_slopes", images * height * 3 if with_gradient else 0, _pitch(width, channels))
        sums = torch.empty(_tiles(*size), 2)
        offsets = _offsets(image, target, *size) if with_gradient else torch.empty(0)
        compare_tiles(image, target, offsets, slopes, sums, *size, int(valid), int(with_gradient))
        border = WINDOW - 1 if valid else 0
        windows = images * (height - border) * (width - border) * channels
        weights = ((1.0 - ssim_lambda) / image.numel(), ssim_lambda / windows)
        gradient = torch.empty(image.shape if with_gradient else 0)
        if with_gradient:
            gradient_tiles(image, target, offsets, slopes, gradient, *size, *weights)
        ctx.save_for_backward(gradient)
        # Tiles were summed in float32; adding them in float64, in a fixed order, keeps the last digits of the mean.
        l1, unlike = sums.sum(dim=0, dtype=torch.float64)
        return (weights[0] * l1 + weights[1] * unlike).to(torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> Any:  # type: ignore[override]
        (gradient,) = ctx.saved_tensors
        return gradient if v_loss == 1 else v_loss * gradient, None, None, None


def l1_ssim_loss(
    image: Tensor,  # [..., H, W, C]
    target: Tensor,  # [..., H, W, C]
    ssim_lambda: float = 0.2,
    padding: Literal["same", "valid"] = "same",
) -> Tensor:
    """The 3DGS training loss (Kerbl et al. 2023, eq. 7), fused, in float32 on all cores.

    (1 - ssim_lambda) mean |image - target| + ssim_lambda (1 - mean SSIM), bit-equal for any number of threads.
    Differentiable in `image`; the gradient is computed along with the value, so going back costs nothing more.

    Args:
        image: Rendered image, usually in [0, 1].
        target: Photograph of the same shape.
        ssim_lambda: Weight of the SSIM term.
        padding: "same" continues the images with black (Inria, fused_ssim's default); "valid" averages SSIM over
            windows inside the image only (gsplat).

    Returns:
        Scalar.

    Raises:
        ValueError: Shapes differ, there are more than 32 channels, an image is too small for "valid", a tensor is
            not a CPU float tensor, or a gradient with respect to `target` is asked for.
    """
    for name, tensor in (("image", image), ("target", target)):
        if not tensor.is_floating_point() or tensor.device.type != "cpu":
            raise ValueError(f"{name} must be a float tensor on the CPU, got {tensor.dtype} on {tensor.device}.")
    if image.shape != target.shape or image.dim() < 3 or image.numel() == 0:
        raise ValueError(
            f"image and target must have one shape [..., H, W, C], got {list(image.shape)} and {list(target.shape)}."
        )
    if image.shape[-1] > MAX_CHANNELS:
        raise ValueError(f"images may have at most {MAX_CHANNELS} channels, got {image.shape[-1]}; are they [H, W, C]?")
    if padding not in ("same", "valid"):
        raise ValueError(f"padding must be 'same' or 'valid', got {padding!r}.")
    if padding == "valid" and min(image.shape[-3:-1]) < WINDOW:
        raise ValueError(
            f"padding='valid' needs images of at least {WINDOW}x{WINDOW} pixels, got "
            f"{image.shape[-2]}x{image.shape[-3]}; use padding='same'."
        )
    if target.requires_grad:
        raise ValueError("l1_ssim_loss is differentiable in image only: pass target.detach().")
    value = _L1Ssim.apply(
        image.to(torch.float32).contiguous(), target.to(torch.float32).contiguous(), ssim_lambda, padding == "valid"
    )
    return value.to(image.dtype)
