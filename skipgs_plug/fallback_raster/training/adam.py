"""One step of Adam on all cores, for whole parameters or for some rows of them."""

from typing import Annotated

import torch
from torch import Tensor

from ..runtime.launch import FloatArray, IntArray, worker
from ..runtime.source import read_kernel

_ALL = torch.empty(0, dtype=torch.int32, device="cpu")  # in place of a mask


@worker(read_kernel("adam.h"), items="n", grain="larger(1, 16384 / width)")
def _adam(
    seen: Annotated[IntArray, "n if only_seen else 0"],
    gradient: Annotated[FloatArray, "n, width"],
    values: Annotated[FloatArray, "n, width"],  # updated, as the next two
    mean: Annotated[FloatArray, "n, width"],  # running mean of the gradient
    square: Annotated[FloatArray, "n, width"],  # running mean of its square
    n: int,
    width: int,
    only_seen: int,
    rate: float,
    root: float,  # divides the root of the squares
    take1: float,  # 1 - the decay of the mean, which loses digits when it is computed in float32
    keep2: float,
    take2: float,
    eps: float,
) -> None: ...


def adam_step(
    seen: Tensor | None,  # [N], all rows without
    values: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    rate: float,
    root: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """One step of Adam in place, float32, contiguous.

    Rounded as torch's fused implementation, to the bit but for means smaller than 1.2e-38, which become zero, and for
    the last numbers of a parameter, which torch does not compute as vectors. Torch's default differs from both by a
    rounding in one number of a thousand: its square root is not the nearest float.

    Args:
        seen: Rows to update, not zero; all without.
        values: The parameter, changed as the next but `gradient`.
        gradient: Of the same shape, as the next two.
        mean: Running mean of the gradient.
        square: Running mean of its square.
        rate: Learning rate, divided by the bias correction of the mean if there is any.
        root: Divides the root of `square`: the root of its bias correction, or 1.
        betas: Decay of the two means.
        eps: Added to the root.
    """
    if values.numel() == 0:
        return
    n = values.numel() if seen is None else len(seen)
    numbers = map(float, (rate, root, 1 - betas[0], betas[1], 1 - betas[1], eps))
    mask = _ALL if seen is None else seen
    _adam(mask, gradient, values, mean, square, n, values.numel() // n, int(seen is not None), *numbers)
    # Past torch's count of changes, by which it knows what is out of date in a backward pass.
    torch.autograd.graph.increment_version(values)


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
    own = param, mean, square
    values, means, squares = dense = [t.contiguous() for t in own]
    adam_step(visibility.to(torch.int32), values, param.grad.contiguous(), means, squares, rate, 1.0, betas, eps)
    for tensor, copy in zip(own, dense, strict=True):
        if copy is not tensor:  # Inria's features are transposed
            tensor.copy_(copy)
