"""Computes the gradients of raw parameters from the sums of pairs in a single kernel.

The kernel applies `reduce_pairs`, `sh_adjoint` and `project_adjoint` to one block of rows at a time. These run one
after the other over all rows when torch needs the gradients in between.
"""

from typing import Annotated, NamedTuple

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput
from .structs import (
    BLOCKS,
    Camera,
    Channels,
    FactorOutput,
    GaussianGradients,
    Gaussians,
    Harmonics,
    HarmonicsGradients,
    PairSums,
    ProjectAdjointFlags,
    ProjectedGradients,
    RowList,
    SplatGradients,
)


class Rendered(NamedTuple):
    """Results of the forward pass for visible rows."""

    colors: Annotated[FloatArray, "n, 3"]
    conics: Annotated[FloatArray, "n, 3"]
    opacities: Annotated[FloatArray, "n"]  # activated, and compensated where antialiased


class CenterGradients(NamedTuple):
    """Packed gradients of the 2D means of visible Gaussians."""

    centers: Annotated[FloatOutput, "sums.M if flags.with_centers else 0, 2"]
    # The kernel adds the sum over pixels of |v_means2d|.
    absolute: Annotated[FloatOutput, "sums.M if flags.absgrad else 0, 2"]


class SplatAdjointFlags(NamedTuple):
    """Inputs and outputs that the adjoint has."""

    antialiased: int  # 1 if opacities were compensated
    with_centers: int  # 1 to write the gradients of the 2D means
    absgrad: int  # 1 to add up the absolute gradients of the 2D means
    optimizations: int  # bits of `OPTIMIZATIONS`


@worker(
    file="splat_adjoint.h",
    items=BLOCKS,
    grain="1",
    structs=(Channels, ProjectAdjointFlags, ProjectedGradients, RowList, SplatGradients),
)
def splat_adjoint(
    *,
    sums: PairSums,
    gaussians: Gaussians,
    logits: Annotated[FloatArray, "n"],
    camera: Camera,
    sh: Harmonics,
    rendered: Rendered,
    v_gaussians: GaussianGradients,
    v_logits: Annotated[FloatOutput, "n"],
    v_sh: HarmonicsGradients,
    factors: FactorOutput,
    v_centers: CenterGradients,
    n: int,
    flags: SplatAdjointFlags,
) -> None: ...
