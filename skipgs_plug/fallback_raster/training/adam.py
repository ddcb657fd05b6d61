"""One step of Adam on all cores, for whole parameters or for some rows of them."""

from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray

_ALL = torch.empty(0, dtype=torch.int32, device="cpu")  # in place of a mask


class Moments(NamedTuple):
    """A parameter and the running means that Adam keeps of its gradient, all changed by a step."""

    values: Annotated[FloatOutput, "n, width"]
    mean: Annotated[FloatOutput, "n, width"]  # of the gradient
    square: Annotated[FloatOutput, "n, width"]  # of its square


class Decay(NamedTuple):
    """The numbers of Adam that stay the same from step to step."""

    take1: float  # 1 - the decay of the mean, which loses digits when it is computed in float32
    keep2: float  # decay of the mean of the squares
    take2: float  # 1 - keep2
    eps: float


def decay(betas: tuple[float, float], eps: float) -> Decay:
    """The numbers of these decays of the two means."""
    return Decay(float(1 - betas[0]), float(betas[1]), float(1 - betas[1]), float(eps))


@worker(file="adam.h", items="n", grain="larger(1, 16384 / width)")
def _adam(
    *,
    wanted: Annotated[IntArray, "n if only_some else 0"],  # rows that get a step
    gradient: Annotated[FloatArray, "n, width"],
    parameter: Moments,
    decay: Decay,
    n: int,
    width: int,
    only_some: int,
    rate: float,  # divided by the bias correction of the mean
    root: float,  # divides the root of the squares
) -> None: ...


def adam_step(
    wanted: Tensor | None,  # [N], all rows without
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
        wanted: Not zero for each row to update; None for all rows.
        values: The parameter. The step changes it in place.
        gradient: Its gradient, of the same shape.
        mean: Running mean of the gradient, of the same shape. The step changes it in place.
        square: Running mean of the squared gradient, of the same shape. The step changes it in place.
        rate: Learning rate, divided by the bias correction of the mean if there is any.
        root: Divides the root of `square`: the root of its bias correction, or 1.
        betas: Decay of the two means.
        eps: Added to the root.
    """
    if values.numel() == 0:
        return
    n = values.numel() if wanted is None else len(wanted)
    _adam(
        wanted=_ALL if wanted is None else wanted,
        gradient=gradient,
        parameter=Moments(values, mean, square),
        decay=decay(betas, eps),
        n=n,
        width=values.numel() // n,
        only_some=int(wanted is not None),
        rate=float(rate),
        root=float(root),
    )
    # Past torch's count of changes, by which it knows what is out of date in a backward pass.
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
