"""3D Gaussians to the image plane (EWA splatting, Zwicker et al. 2001; formulas as in gsplat 1.5), 16 at a time.

The raw parameters of a trainer, logarithms of scales and logits of opacities, are read as they are where `raw`.
How the covariances keep their digits is explained in `kernels/lib/geometry.h`.
"""

from typing import Annotated

from ..runtime.launch import FloatArray, IntArray, worker
from ..runtime.source import read_kernel


@worker(read_kernel("project_forward.h"), items="(n + BLOCK - 1) / BLOCK", grain="1")
def project_forward(
    means: Annotated[FloatArray, "n, 3"],
    quats: Annotated[FloatArray, "n, 4"],
    scales: Annotated[FloatArray, "n, 3"],  # where `raw`, their logarithms
    opacities: Annotated[FloatArray, "n"],  # where `raw`, their logits
    viewmat: Annotated[FloatArray, "4, 4"],
    K: Annotated[FloatArray, "3, 3"],
    means2d: Annotated[FloatArray, "n, 2"],  # out
    depths: Annotated[FloatArray, "n"],  # out
    conics: Annotated[FloatArray, "n, 3"],  # out, upper triangle of the inverse 2D covariance
    sigmas: Annotated[FloatArray, "n, 2"],  # out, standard deviations along x and y in pixels
    compensations: Annotated[FloatArray, "n if antialiased else 0"],  # out
    radii: Annotated[IntArray, "n if with_radii else 0, 2"],  # out, zero where the Gaussian is not visible
    activated: Annotated[FloatArray, "n if raw else 0"],  # out, opacities, compensated where antialiased
    seen: Annotated[IntArray, "n"],  # out, the rows with a radius, from where their block begins
    block_count: Annotated[IntArray, "blocks(n)"],  # out, their number in each block
    n: int,
    width: float,
    height: float,
    near_plane: float,
    far_plane: float,
    eps2d: float,
    radius_clip: float,
    antialiased: int,
    raw: int,
    dense: int,  # whether to write rows that are not visible
    with_radii: int,
    optimizations: int,
) -> None: ...


@worker(read_kernel("list_visible.h"), items="1", grain="1")
def list_visible(
    seen: Annotated[IntArray, "n"],
    block_count: Annotated[IntArray, "blocks"],
    visible: Annotated[IntArray, "n"],  # out
    block_start: Annotated[IntArray, "blocks + 1"],  # out, where each block of rows begins in `visible`
    blocks: int,
) -> None: ...


@worker(read_kernel("project_backward.h"), items="(n + BLOCK - 1) / BLOCK", grain="1")
def project_backward(
    means: Annotated[FloatArray, "n, 3"],
    quats: Annotated[FloatArray, "n, 4"],
    scales: Annotated[FloatArray, "n, 3"],
    viewmat: Annotated[FloatArray, "4, 4"],
    K: Annotated[FloatArray, "3, 3"],
    visible: Annotated[IntArray, "M"],  # rows with a radius
    block_start: Annotated[IntArray, "blocks(n) + 1"],  # where each block of rows begins in `visible`
    v_means2d: Annotated[FloatArray, "n, 2"],
    v_depths: Annotated[FloatArray, "n if with_depth else 0"],
    v_conics: Annotated[FloatArray, "n, 3"],
    v_compensations: Annotated[FloatArray, "n if antialiased else 0"],
    v_means: Annotated[FloatArray, "n, 3"],  # out
    v_quats: Annotated[FloatArray, "n, 4"],  # out
    v_scales: Annotated[FloatArray, "n, 3"],  # out
    v_poses: Annotated[FloatArray, "blocks(n) if with_pose else 0, 3, 4"],  # out, partial sums
    n: int,
    width: float,
    height: float,
    eps2d: float,
    with_depth: int,
    antialiased: int,
    with_pose: int,
    optimizations: int,
) -> None: ...
