"""What densification knows of a Gaussian: how far the views that show it would move it on their images."""

from typing import Annotated

from torch import Tensor

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray


@worker(file="sum_norms.h", items="n", grain="4096")
def _sum_norms(
    *,
    rows: Annotated[IntArray, "n"],  # none of them twice
    gradient: Annotated[FloatArray, "n, 2"],
    norms: Annotated[FloatOutput, "R"],  # the kernel adds to these
    counts: Annotated[FloatOutput, "R"],  # and to these
    n: int,
    scale_x: float,
    scale_y: float,
) -> None: ...


def sum_norms(
    rows: Tensor,  # [M] int32, none of them twice
    gradient: Tensor,  # [M, 2] float32, of the 2D means
    scale: tuple[float, float],  # by which both columns are multiplied first
    norms: Tensor,  # [N] float32, changed in place
    counts: Tensor,  # [N] float32, changed in place
) -> None:
    """Add the norms of gradients to `norms` and 1 to `counts`, for the rows that an image shows."""
    _sum_norms(
        rows=rows,
        gradient=gradient.contiguous(),
        norms=norms,
        counts=counts,
        n=len(rows),
        scale_x=float(scale[0]),
        scale_y=float(scale[1]),
    )
