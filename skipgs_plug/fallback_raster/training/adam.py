"""One step of Adam on all cores, for all rows of a parameter or for some of them."""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray

_NO_MASK = torch.empty(0, dtype=torch.int32, device="cpu")  # stands for a mask of rows: all rows are updated


class Moments(NamedTuple):
    """A parameter and the two moments that Adam keeps of its gradient. A step changes all three."""

    values: Annotated[FloatOutput, "n, width"]
    mean: Annotated[FloatOutput, "n, width"]  # running mean of the gradient
    square: Annotated[FloatOutput, "n, width"]  # running mean of the squared gradient


class Decay(NamedTuple):
    """The coefficients of Adam that are the same in every step."""

    take1: float  # 1 - beta1, computed in float64: the difference would lose digits in float32
    keep2: float  # beta2
    take2: float  # 1 - beta2, computed in float64
    eps: float


def decay(betas: tuple[float, float], eps: float) -> Decay:
    """Return the coefficients for these decays of the two moments."""
    return Decay(float(1 - betas[0]), float(betas[1]), float(1 - betas[1]), float(eps))


@worker(file="adam.h", items="n", grain="larger(1, 16384 / width)")
def _adam(
    *,
    wanted: Annotated[IntArray, "n if only_some else 0"],  # not zero for rows that get a step
    gradient: Annotated[FloatArray, "n, width"],
    parameter: Moments,
    decay: Decay,
    n: int,
    width: int,
    only_some: int,
    rate: float,  # learning rate, divided by the bias correction of the mean
    root: float,  # square root of the bias correction of the squares
) -> None: ...


def adam_step(
    wanted: Tensor | None,  # [N] int32
    values: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    rate: float,
    root: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Apply one step of Adam (Kingma and Ba 2015) in place to contiguous float32 tensors, on all cores.

    The result equals torch's fused implementation to the bit, with two exceptions: means smaller than 1.2e-38 become
    zero, and the last few numbers of a parameter differ, which torch does not compute as vectors. Torch's default
    implementation differs from both by one rounding in about one number of a thousand, because its square root is not
    correctly rounded.

    Args:
        wanted: Not zero for each row to update. None updates all rows.
        values: The parameter. The step changes it in place.
        gradient: Its gradient, of the same shape.
        mean: Running mean of the gradient, of the same shape. The step changes it in place.
        square: Running mean of the squared gradient, of the same shape. The step changes it in place.
        rate: Learning rate, divided by the bias correction of the mean if there is one.
        root: Square root of the bias correction of `square`, or 1 without a correction.
        betas: Decays of the two means.
        eps: Added to the square root of `square`.
    """
    if values.numel() == 0:
        return
    n = values.numel() if wanted is None else len(wanted)
    _adam(
        wanted=_NO_MASK if wanted is None else wanted,
        gradient=gradient,
        parameter=Moments(values, mean, square),
        decay=decay(betas, eps),
        n=n,
        width=values.numel() // n,
        only_some=int(wanted is not None),
        rate=float(rate),
        root=float(root),
    )
    # Kernels bypass torch's version counter, with which it detects outdated tensors in a backward pass.
    torch.autograd.graph.increment_version(values)


@torch.no_grad()
def adam_rows(
    visibility: Tensor,  # [N] bool
    param: Tensor,  # [N, ...], updated in place
    mean: Tensor,  # of the same shape, updated in place
    square: Tensor,  # of the same shape, updated in place
    rate: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Apply one step of Adam without bias correction to the visible rows, on all cores.

    Other rows keep their values and moments, as with the CUDA kernels of Taming 3DGS and gsplat's SelectiveAdam.

    Args:
        visibility: Whether to update each row, [N] bool.
        param: Parameter [N, ...] with a gradient, float32, changed in place. On devices other than the CPU, plain torch
            updates it.
        mean: Running mean of its gradient, of the same shape, changed in place.
        square: Running mean of its squared gradient, of the same shape, changed in place.
        rate: Learning rate.
        betas: Decays of the two means.
        eps: Added to the square root of `square`.
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
