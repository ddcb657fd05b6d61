"""Spherical harmonics up to degree 3 to view-dependent colour: max(0, 0.5 + sum_k basis_k(direction) * sh_k).

Real basis with the signs of 3DGS (Kerbl et al. 2023). Only Gaussians with a radius are evaluated. The constant band of
Gaussian g lies at `base_stride` g of `base`, the others at `rest_stride` g + `rest_offset` of `rest`, which may be the
same array.
"""

from typing import Annotated

from ..runtime.launch import FloatArray, IntArray, worker
from ..runtime.source import read_kernel


@worker(read_kernel("sh_forward.h"), items="(n + BLOCK - 1) / BLOCK", grain="1")
def sh_forward(
    means: Annotated[FloatArray, "n, 3"],
    camera: Annotated[FloatArray, "3"],  # its centre in world space
    base: Annotated[FloatArray, "n, base_stride"],
    rest: Annotated[FloatArray, "n, rest_stride"],
    visible: Annotated[IntArray, "M"],
    block_start: Annotated[IntArray, "blocks(n) + 1"],  # where each block of rows begins in `visible`
    colors: Annotated[FloatArray, "n, 3"],  # out, zero where not visible and `dense`
    n: int,
    base_stride: int,
    rest_stride: int,
    rest_offset: int,
    degree: int,  # 0 to 3
    dense: int,
) -> None: ...


@worker(read_kernel("sh_backward.h"), items="(n + BLOCK - 1) / BLOCK", grain="1")
def sh_backward(
    means: Annotated[FloatArray, "n, 3"],
    camera: Annotated[FloatArray, "3"],
    base: Annotated[FloatArray, "n, base_stride"],
    rest: Annotated[FloatArray, "n, rest_stride"],
    visible: Annotated[IntArray, "M"],
    block_start: Annotated[IntArray, "blocks(n) + 1"],
    colors: Annotated[FloatArray, "n, 3"],  # result of the forward pass
    v_colors: Annotated[FloatArray, "n, 3"],
    v_means: Annotated[FloatArray, "n, 3"],  # out
    v_base: Annotated[FloatArray, "n, base_stride"],  # out
    v_rest: Annotated[FloatArray, "n, rest_stride"],  # out; v_base where rest and base are one array
    v_cameras: Annotated[FloatArray, "blocks(n), 3"],  # out, partial sums
    n: int,
    base_stride: int,
    rest_stride: int,
    rest_offset: int,
    degree: int,
    optimizations: int,
) -> None: ...


@worker(read_kernel("sh_bands.h"), items="n", grain="BLOCK")
def sh_bands(
    directions: Annotated[FloatArray, "n, FACTOR"],
    bands: Annotated[FloatArray, "n, BANDS"],  # out, beside the constant one
    n: int,
    degree: int,
) -> None: ...
