"""3D Gaussians to the image plane (EWA splatting, Zwicker et al. 2001; formulas as in gsplat 1.5), 16 at a time.

The raw parameters of a trainer, logarithms of scales and logits of opacities, are read as they are where `raw`.
How the covariances keep their digits is explained in `kernels/lib/geometry.h`.
"""

from typing import Annotated, NamedTuple

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray, IntOutput
from .structs import BlockRows, Camera, GaussianGradients, Gaussians, ProjectedGradients, RowList


class Limits(NamedTuple):
    """What is left out of an image."""

    near_plane: float  # Gaussians nearer than this, world units
    far_plane: float  # Gaussians farther than this
    radius_clip: float  # Gaussians of at most this radius, pixels


class Projected(NamedTuple):
    """Gaussians on the image plane, zeros or, unless `dense`, nothing where they are not visible."""

    means2d: Annotated[FloatOutput, "n, 2"]
    depths: Annotated[FloatOutput, "n"]
    conics: Annotated[FloatOutput, "n, 3"]  # upper triangle of the inverse 2D covariance
    sigmas: Annotated[FloatOutput, "n, 2"]  # standard deviations along x and y in pixels
    compensations: Annotated[FloatOutput, "n if antialiased else 0"]  # of opacities, for the area that `eps2d` adds
    radii: Annotated[IntOutput, "n if with_radii else 0, 2"]  # pixels
    opacities: Annotated[FloatOutput, "n if raw else 0"]  # activated, and compensated where antialiased


@worker(file="project_forward.h", items="(n + BLOCK - 1) / BLOCK", grain="1")
def project_forward(
    *,
    gaussians: Gaussians,
    opacities: Annotated[FloatArray, "n"],  # where `raw`, their logits
    camera: Camera,
    limits: Limits,
    projected: Projected,
    found: BlockRows,  # visible rows
    n: int,
    antialiased: int,
    raw: int,
    dense: int,  # whether to write rows that are not visible
    with_radii: int,
    optimizations: int,
) -> None: ...


@worker(file="list_visible.h", items="1", grain="1")
def list_visible(
    *,
    found: Annotated[IntArray, "n"],
    block_count: Annotated[IntArray, "blocks"],
    visible: Annotated[IntOutput, "n"],
    block_start: Annotated[IntOutput, "blocks + 1"],  # where each block of rows begins in `visible`
    blocks: int,
) -> None: ...


@worker(file="project_adjoint.h", items="(n + BLOCK - 1) / BLOCK", grain="1")
def project_adjoint(
    *,
    gaussians: Gaussians,
    camera: Camera,
    visible: RowList,
    v_projected: ProjectedGradients,
    v_gaussians: GaussianGradients,
    v_poses: Annotated[FloatOutput, "blocks(n) if with_pose else 0, 3, 4"],  # partial sums of the viewmat's gradient
    n: int,
    with_depth: int,
    antialiased: int,
    with_pose: int,
    optimizations: int,
) -> None: ...
