"""Projects 3D Gaussians to the image plane, 16 at a time (EWA splatting, Zwicker et al. 2001; formulas of gsplat 1.5).

With `raw` the kernels read a trainer's parameters directly: logarithms of scales and logits of opacities.
`kernels/lib/geometry.h` explains how the covariances keep their digits.
"""

from typing import Annotated, NamedTuple

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray, IntOutput
from .structs import (
    BLOCKS,
    BlockRows,
    Camera,
    GaussianGradients,
    Gaussians,
    ProjectAdjointFlags,
    ProjectedGradients,
    RowList,
)


class Limits(NamedTuple):
    """Limits beyond which Gaussians are culled."""

    near_plane: float  # Gaussians nearer than this, world units
    far_plane: float  # Gaussians farther than this
    radius_clip: float  # Gaussians of at most this radius, pixels


class ProjectFlags(NamedTuple):
    """Inputs and outputs that the projection has."""

    antialiased: int  # 1 to compensate opacities for `eps2d`
    raw: int  # 1 if scales are logarithms and opacities are logits
    dense: int  # 1 to write zeros for rows that are not visible
    with_radii: int
    optimizations: int  # bits of `OPTIMIZATIONS`


class Projected(NamedTuple):
    """Gaussians on the image plane. Rows that are not visible are zero with `dense`, and undefined without."""

    means2d: Annotated[FloatOutput, "n, 2"]
    depths: Annotated[FloatOutput, "n"]
    conics: Annotated[FloatOutput, "n, 3"]  # upper triangle of the inverse 2D covariance
    sigmas: Annotated[FloatOutput, "n, 2"]  # standard deviations along x and y in pixels
    compensations: Annotated[FloatOutput, "n if flags.antialiased else 0"]  # factors of opacities, for `eps2d`
    radii: Annotated[IntOutput, "n if flags.with_radii else 0, 2"]  # pixels
    opacities: Annotated[FloatOutput, "n if flags.raw else 0"]  # activated, and compensated where antialiased


@worker(file="project_forward.h", items=BLOCKS, grain="1")
def project_forward(
    *,
    gaussians: Gaussians,
    opacities: Annotated[FloatArray, "n"],  # logits if `raw`
    camera: Camera,
    limits: Limits,
    projected: Projected,
    found: BlockRows,  # visible rows
    n: int,
    flags: ProjectFlags,
) -> None: ...


@worker(file="list_visible.h", items="1", grain="1")
def list_visible(
    *,
    found: Annotated[IntArray, "n"],
    block_count: Annotated[IntArray, "blocks"],
    visible: Annotated[IntOutput, "n"],
    block_start: Annotated[IntOutput, "blocks + 1"],  # start of each block of rows in `visible`
    blocks: int,
) -> None: ...


@worker(file="project_adjoint.h", items=BLOCKS, grain="1")
def project_adjoint(
    *,
    gaussians: Gaussians,
    camera: Camera,
    visible: RowList,
    v_projected: ProjectedGradients,
    v_gaussians: GaussianGradients,
    v_poses: Annotated[FloatOutput, "blocks(n) if flags.with_pose else 0, 3, 4"],  # viewmat's gradient, by block
    n: int,
    flags: ProjectAdjointFlags,
) -> None: ...
