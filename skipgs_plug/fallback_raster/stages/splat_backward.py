"""Gradients of raw parameters, from the sums of pairs to the last product in one kernel.

What it does for one block of rows after the other, `reduce_pairs`, `sh_backward` and `project_backward` do one after
the other for all rows, where torch wants the gradients in between.
"""

from typing import Annotated

from ..runtime.launch import FloatArray, IntArray, worker
from ..runtime.source import read_kernel


@worker(read_kernel("splat_backward.h"), items="(n + BLOCK - 1) / BLOCK", grain="1")
def splat_backward(
    visible: Annotated[IntArray, "M"],  # the first eight as `PairSums` has them
    block_start: Annotated[IntArray, "blocks(n) + 1"],
    pair_start: Annotated[IntArray, "M + 1"],
    far_visible: Annotated[IntArray, "F"],
    far_block_start: Annotated[IntArray, "blocks(n) + 1"],
    far_pair_start: Annotated[IntArray, "F + 1"],
    pair_slot: Annotated[IntArray, "P"],
    v_pairs: Annotated[FloatArray, "Q, PAIR"],
    means: Annotated[FloatArray, "n, 3"],
    quats: Annotated[FloatArray, "n, 4"],
    scales: Annotated[FloatArray, "n, 3"],  # logarithms
    opacities: Annotated[FloatArray, "n"],  # logits
    base: Annotated[FloatArray, "n, 3"],
    rest: Annotated[FloatArray, "n, rest_stride"],
    viewmat: Annotated[FloatArray, "4, 4"],
    K: Annotated[FloatArray, "3, 3"],
    camera: Annotated[FloatArray, "3"],  # its centre in world space
    colors: Annotated[FloatArray, "n, 3"],  # results of the forward pass, as the next two
    conics: Annotated[FloatArray, "n, 3"],
    activated: Annotated[FloatArray, "n"],  # opacities
    v_means: Annotated[FloatArray, "n, 3"],  # out, as all that follow
    v_quats: Annotated[FloatArray, "n, 4"],
    v_scales: Annotated[FloatArray, "n, 3"],
    v_opacities: Annotated[FloatArray, "n"],
    v_base: Annotated[FloatArray, "n, 3"],
    v_rest: Annotated[FloatArray, "0 if outer else n, rest_stride"],
    factor_directions: Annotated[FloatArray, "M if outer and degree else 0, FACTOR"],  # in place of v_rest, as the next
    factor_colors: Annotated[FloatArray, "M if outer and degree else 0, FACTOR"],
    v_centers: Annotated[FloatArray, "M if with_centers else 0, 2"],  # of the Gaussians on the image plane
    absolute: Annotated[FloatArray, "M if absgrad else 0, 2"],  # added to
    n: int,
    width: float,
    height: float,
    eps2d: float,
    rest_stride: int,
    degree: int,  # 0 to 3
    outer: int,  # whether the gradient of the higher bands is wanted in factors
    antialiased: int,
    with_centers: int,
    absgrad: int,
    parts: int,
    optimizations: int,
) -> None: ...
