"""The 3DGS loss, (1 - w) L1 + w (1 - SSIM), value and gradient in one go.

SSIM (Wang et al. 2004) with an 11x11 Gaussian window of sigma 1.5. Images stay channels-last, as the rasterizer
returns them: a blur along a row is a blur with stride C over a flat row. The two variances enter SSIM only as their
sum, so four blurred maps are enough (x, y, x^2 + y^2, x y) instead of five, and three for the adjoint. Variances do
not change when a constant is subtracted; 0.5 is, because in float32 E[x^2] - E[x]^2 loses digits on bright areas.
"""

from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .launch import FloatArray, scratch, worker

WINDOW = 11
SIGMA = 1.5

# `at(row, i)` is the shifted image from flat position i on; a pixel outside is black. `shifted` maps have `pitch`
# floats per row, a multiple of 16, so that vertical passes need no such care.
_WINDOW = """
const float w[11] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601172f,
                     0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
const int span = width * channels, pitch = (span + 15) / 16 * 16;
const long long map = (long long)images * height * pitch;
auto inside = [&](const float* row, int i, float outside) -> v16 {
    if (i >= 0 && i + 16 <= span) return load(row + i);
    v16 v;
    for (int l = 0; l < 16; ++l) v[l] = i + l >= 0 && i + l < span ? row[i + l] : outside;
    return v;
};
auto at = [&](const float* row, int i) -> v16 { return inside(row, i, 0.0f) - 0.5f; };
"""


@worker(
    _WINDOW
    + """
for (int row = first; row < last; ++row) {
    const float *x = image + (long long)row * span, *y = target + (long long)row * span;
    float* out = blurred + (long long)row * pitch;
    for (int i = 0; i < span; i += 16) {
        v16 mean_x = (v16)0.0f, mean_y = mean_x, squares = mean_x, products = mean_x;
        for (int k = 0; k < 11; ++k) {
            const v16 a = at(x, i + (k - 5) * channels), b = at(y, i + (k - 5) * channels);
            mean_x += w[k] * a;
            mean_y += w[k] * b;
            squares += w[k] * (a * a + b * b);
            products += w[k] * (a * b);
        }
        store(out + i, mean_x);
        store(out + map + i, mean_y);
        store(out + 2 * map + i, squares);
        store(out + 3 * map + i, products);
    }
}
""",
    items="images * height",
    grain=8,
)
def blur_rows(
    image: FloatArray,  # [B, H, W, C]
    target: FloatArray,  # [B, H, W, C]
    blurred: FloatArray,  # out [4, B, H, pitch], along rows
    images: int,  # B
    height: int,
    width: int,
    channels: int,
) -> None: ...


@worker(
    _WINDOW
    + """
for (int row = first; row < last; ++row) {
    const int y = row % height;
    const float* here = blurred + (long long)row * pitch;
    float* slope = slopes + (long long)row * pitch;
    float* out = spread + (long long)row * pitch;
    // Rows of the window that lie inside the image, and the weight of those that do not.
    const int begin = larger(0, 5 - y), end = smaller(11, height + 5 - y);
    float outside = 1.0f;
    for (int k = begin; k < end; ++k) outside -= w[k];
    if (begin == 0 && end == 11) outside = 0.0f;
    v16 total = (v16)0.0f;
    const bool row_counts = !valid || (y >= 5 && y < height - 5);
    for (int i = 0; i < span; i += 16) {
        const v16 column = lane + (float)i;
        const i16 counts = (column < (float)(valid ? span - 5 * channels : span))
                         & (column >= (float)(valid ? 5 * channels : 0));
        if (!row_counts || !any(counts)) {
            for (int m = 0; m < 3; ++m) store(slope + m * map + i, (v16)0.0f);
            continue;
        }
        // A blurred row outside the image holds a constant, by map: all of the image is 0 - 0.5 there.
        const float beyond[4] = {-0.5f, -0.5f, 0.5f, 0.25f};
        v16 blur[4];
        for (int m = 0; m < 4; ++m) {
            blur[m] = (v16)(outside * beyond[m]);
            for (int k = begin; k < end; ++k) blur[m] += w[k] * load(here + m * map + (k - 5) * pitch + i);
        }
        const v16 mx = blur[0] + 0.5f, my = blur[1] + 0.5f;
        const v16 variances = vmax(blur[2] - blur[0] * blur[0] - blur[1] * blur[1], (v16)0.0f);
        const v16 covariance = blur[3] - blur[0] * blur[1];
        const v16 a1 = 2.0f * mx * my + 1e-4f, a2 = 2.0f * covariance + 9e-4f;
        const v16 b1 = 1.0f / (mx * mx + my * my + 1e-4f), b2 = 1.0f / (variances + 9e-4f);
        const v16 ssim = a1 * a2 * b1 * b2;
        total += counts ? ssim : (v16)0.0f;
        // Derivatives with respect to the blurred x, x^2 + y^2 and x y, shifted as they are.
        const v16 d_products = 2.0f * a1 * b1 * b2, d_squares = -ssim * b2;
        const v16 d_mean = 2.0f * my * a2 * b1 * b2 - 2.0f * mx * ssim * b1 - blur[1] * d_products
                         - 2.0f * blur[0] * d_squares;
        store(slope + i, counts ? d_mean : (v16)0.0f);
        store(slope + map + i, counts ? d_squares : (v16)0.0f);
        store(slope + 2 * map + i, counts ? d_products : (v16)0.0f);
    }
    sums[row] = sum(total);
    if (!with_gradient) continue;
    for (int m = 0; m < 3; ++m)
        for (int i = 0; i < span; i += 16) {
            v16 v = (v16)0.0f;
            for (int k = 0; k < 11; ++k) v += w[k] * inside(slope + m * map, i + (k - 5) * channels, 0.0f);
            store(out + m * map + i, v);
        }
}
""",
    items="images * height",
    grain=8,
)
def ssim_rows(
    blurred: FloatArray,  # [4, B, H, pitch], along rows
    slopes: FloatArray,  # scratch [3, B, H, pitch]
    spread: FloatArray,  # out [3, B, H, pitch], derivatives of SSIM, blurred along rows
    sums: FloatArray,  # out [B * H], SSIM summed over each row
    images: int,
    height: int,
    width: int,
    channels: int,
    valid: int,
    with_gradient: int,
) -> None: ...


@worker(
    _WINDOW
    + """
for (int row = first; row < last; ++row) {
    const int y = row % height;
    const float *x = image + (long long)row * span, *t = target + (long long)row * span;
    const float* here = spread + (long long)row * pitch;
    float* out = gradient + (long long)row * span;
    const int begin = larger(0, 5 - y), end = smaller(11, height + 5 - y);
    v16 total = (v16)0.0f;
    for (int i = 0; i < span; i += 16) {
        const v16 a = at(x, i), b = at(t, i), difference = a - b;
        total += vabs(difference);  // nothing differs outside the image
        if (!with_gradient) continue;
        v16 d[3];
        for (int m = 0; m < 3; ++m) {
            d[m] = (v16)0.0f;
            for (int k = begin; k < end; ++k) d[m] += w[k] * load(here + m * map + (k - 5) * pitch + i);
        }
        const v16 sign = difference > 0.0f ? (v16)1.0f : (difference < 0.0f ? (v16)-1.0f : (v16)0.0f);
        const v16 v = l1_weight * sign + ssim_weight * (d[0] + 2.0f * a * d[1] + b * d[2]);
        if (i + 16 <= span) store(out + i, v);
        else for (int l = 0; i + l < span; ++l) out[i + l] = v[l];
    }
    sums[row] = sum(total);
}
""",
    items="images * height",
    grain=8,
)
def gradient_rows(
    image: FloatArray,  # [B, H, W, C]
    target: FloatArray,  # [B, H, W, C]
    spread: FloatArray,  # [3, B, H, pitch]
    gradient: FloatArray,  # out [B, H, W, C], only written with_gradient
    sums: FloatArray,  # out [B * H], |image - target| summed over each row
    images: int,
    height: int,
    width: int,
    channels: int,
    l1_weight: float,
    ssim_weight: float,
    with_gradient: int,
) -> None: ...


class _L1Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_lambda: float, valid: bool) -> Tensor:  # type: ignore[override]
        height, width, channels = image.shape[-3:]
        images = image.numel() // (height * width * channels)
        pitch = (width * channels + 15) // 16 * 16
        size = (images, height, width, channels)
        with_gradient = ctx.needs_input_grad[0]
        blurred = scratch("blurred", 4, images, height, pitch)
        blur_rows(image, target, blurred, *size)
        slopes = scratch("slopes", 3, images, height, pitch)
        spread = scratch("spread", 3 if with_gradient else 0, images, height, pitch)
        ssim = torch.empty(images * height)
        ssim_rows(blurred, slopes, spread, ssim, *size, int(valid), int(with_gradient))
        l1 = torch.empty(images * height)
        gradient = torch.empty(image.shape if with_gradient else 0)
        border = WINDOW - 1 if valid else 0
        windows = images * (height - border) * (width - border) * channels
        weights = ((1.0 - ssim_lambda) / image.numel(), -ssim_lambda / windows)
        gradient_rows(image, target, spread, gradient, l1, *size, *weights, int(with_gradient))
        ctx.save_for_backward(gradient)
        # Rows were summed in float32; adding rows in float64 keeps the last digits of the mean.
        value = weights[0] * l1.sum(dtype=torch.float64) + ssim_lambda + weights[1] * ssim.sum(dtype=torch.float64)
        return value.to(torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> Any:  # type: ignore[override]
        (gradient,) = ctx.saved_tensors
        return v_loss * gradient, None, None, None


def l1_ssim_loss(
    image: Tensor,  # [..., H, W, C]
    target: Tensor,  # [..., H, W, C]
    ssim_lambda: float = 0.2,
    padding: Literal["same", "valid"] = "same",
) -> Tensor:
    """The 3DGS training loss (Kerbl et al. 2023, eq. 7), fused, in float32 on all cores.

    (1 - ssim_lambda) mean |image - target| + ssim_lambda (1 - mean SSIM), bit-equal for any number of threads.
    Differentiable in `image`; the gradient is computed along with the value, so calling it costs nothing more.

    Args:
        image: Rendered image, usually in [0, 1].
        target: Photograph of the same shape.
        ssim_lambda: Weight of the SSIM term.
        padding: "same" continues the images with black (Inria, fused_ssim's default); "valid" averages SSIM over
            windows inside the image only (gsplat).

    Returns:
        Scalar.

    Raises:
        ValueError: Shapes differ, an image is too small for "valid", a tensor is not a CPU float tensor, or a
            gradient with respect to `target` is asked for.
    """
    for name, tensor in (("image", image), ("target", target)):
        if not tensor.is_floating_point() or tensor.device.type != "cpu":
            raise ValueError(f"{name} must be a float tensor on the CPU, got {tensor.dtype} on {tensor.device}.")
    if image.shape != target.shape or image.dim() < 3 or image.numel() == 0:
        raise ValueError(
            f"image and target must have one shape [..., H, W, C], got {list(image.shape)} and {list(target.shape)}."
        )
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
