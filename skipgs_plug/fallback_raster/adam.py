"""Adam for some rows only: what a Gaussian that no pixel sees does not need."""

from typing import Annotated

import torch
from torch import Tensor

from .launch import FloatArray, IntArray, worker
from .source import read_kernel


@worker(read_kernel("adam.h"), items="n", grain="2048")
def _adam(
    seen: Annotated[IntArray, "n"],
    gradient: Annotated[FloatArray, "n, width"],
    values: Annotated[FloatArray, "n, width"],  # updated, as the next two
    mean: Annotated[FloatArray, "n, width"],  # running mean of the gradient
    square: Annotated[FloatArray, "n, width"],  # running mean of its square
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
