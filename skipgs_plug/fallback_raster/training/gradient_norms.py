"""Sums of the gradients of 2D means, by which densification decides which Gaussians to split or clone."""

from typing import Annotated

from torch import Tensor

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray


@worker(file="sum_norms.h", items="n", grain="4096")
def _sum_norms(
    *,
    rows: Annotated[IntArray, "n"],  # no row twice
    gradient: Annotated[FloatArray, "n, 2"],
    norms: Annotated[FloatOutput, "R"],  # the kernel adds to it
    counts: Annotated[FloatOutput, "R"],  # the kernel adds to it
    n: int,
    scale_x: float,
    scale_y: float,
) -> None: ...


def sum_norms(
    rows: Tensor,  # [M] int32, no row twice
    gradient: Tensor,  # [M, 2] float32, of the 2D means
    scale: tuple[float, float],  # factors of the two columns
    norms: Tensor,  # [N] float32, changed in place
    counts: Tensor,  # [N] float32, changed in place
) -> None:
    """Add the norm of each gradient to `norms` and 1 to `counts`, for the rows that are visible in an image.

    Args:
        rows: Rows [M] of the visible Gaussians, int32, no row twice.
        gradient: Gradients [M, 2] of their 2D means, float32.
        scale: Factors of x and y, applied before the norm, such as half the image's size in pixels.
        norms: Sums of norms [N], float32, changed in place.
        counts: Numbers of images [N], float32, changed in place.
    """
    _sum_norms(
        rows=rows,
        gradient=gradient.contiguous(),
        norms=norms,
        counts=counts,
        n=len(rows),
        scale_x=float(scale[0]),
        scale_y=float(scale[1]),
    )
