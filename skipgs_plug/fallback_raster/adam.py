"""Adam for some rows only: what a Gaussian that no pixel sees does not need."""

import torch
from torch import Tensor

from .launch import FloatArray, IntArray, worker


@worker(
    """
const long long block_end = (long long)last * width;
for (int row = first; row < last;) {
    if (!seen[row]) {
        ++row;
        continue;
    }
    // A run of visible rows is one line of floats. What a vector holds beyond its end is written back as it was.
    const long long begin = (long long)row * width;
    while (row < last && seen[row]) ++row;
    const long long end = (long long)row * width;
    for (long long i = begin; i < end; i += 16) {
        if (i + 16 > block_end) {  // a whole vector would reach into rows of another core
            for (long long j = i; j < end; ++j) {
                const float g = gradient[j];
                mean[j] = keep1 * mean[j] + take1 * g;
                square[j] = keep2 * square[j] + take2 * g * g;
                values[j] -= rate * mean[j] / (__builtin_elementwise_sqrt(square[j]) + eps);
            }
            break;
        }
        const i16 own = lane < (float)(end - i < 16 ? end - i : 16);
        const v16 g = load(gradient + i), m = load(mean + i), s = load(square + i), x = load(values + i);
        const v16 new_m = keep1 * m + take1 * g, new_s = keep2 * s + take2 * g * g;
        store(mean + i, own ? new_m : m);
        store(square + i, own ? new_s : s);
        store(values + i, own ? x - rate * new_m / (vsqrt(new_s) + eps) : x);
    }
}
""",
    items="n",
    grain=2048,
)
def _adam(
    seen: IntArray,  # [N]
    gradient: FloatArray,  # [N, width]
    values: FloatArray,  # [N, width], updated, as the next two
    mean: FloatArray,  # [N, width], running mean of the gradient
    square: FloatArray,  # [N, width], running mean of its square
    n: int,
    width: int,
    rate: float,
    keep1: float,
    take1: float,  # 1 - keep1, which loses digits when it is computed in float32
    keep2: float,
    take2: float,
    eps: float,
) -> None: ...


@torch.no_grad()
def adam_rows(
    visibility: Tensor,  # [N] bool
    param: Tensor,  # [N, ...], updated, as the next two
    mean: Tensor,  # like param
    square: Tensor,  # like param
    rate: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """One step of Adam without bias correction for the rows that are visible, on all cores.

    As the CUDA kernels of Taming 3DGS and gsplat's SelectiveAdam: other rows keep value and moments.

    Args:
        visibility: Rows to update.
        param: Parameter with a gradient, float32; elsewhere than on the CPU plain torch updates it.
        mean: Its running mean of gradients.
        square: Its running mean of squared gradients.
        rate: Learning rate.
        betas: Decay of the two means.
        eps: Added to the root of the squares.
    """
    assert param.grad is not None
    if param.device.type != "cpu":
        rows = torch.nonzero(visibility)[:, 0]
        gradient = param.grad[rows]
        mean[rows] = torch.lerp(gradient, mean[rows], betas[0])
        square[rows] = torch.lerp(gradient * gradient, square[rows], betas[1])
        param[rows] -= rate * mean[rows] / (square[rows].sqrt() + eps)
        return
    width = param.numel() // max(len(param), 1)
    seen, gradient = visibility.to(torch.int32), param.grad.contiguous()
    decays = (share for beta in betas for share in (beta, 1.0 - beta))
    own = param, mean, square
    dense = [t.contiguous() for t in own]
    _adam(seen, gradient, *dense, len(param), width, rate, *decays, eps)
    for tensor, copy in zip(own, dense, strict=True):
        if copy is not tensor:  # Inria's features are transposed
            tensor.copy_(copy)
