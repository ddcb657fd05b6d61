"""Gradients of raw parameters, from the sums of pairs to the last product in one kernel.

What it does for one block of rows after the other, `reduce_pairs`, `sh_adjoint` and `project_adjoint` do one after
the other for all rows, where torch wants the gradients in between.
"""

from typing import Annotated, NamedTuple

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput
from .structs import (
    Camera,
    Channels,
    FactorOutput,
    GaussianGradients,
    Gaussians,
    Harmonics,
    HarmonicsGradients,
    PairSums,
    ProjectedGradients,
    RowList,
    SplatGradients,
)


class Rendered(NamedTuple):
    """Results of the forward pass, of visible rows."""

    colors: Annotated[FloatArray, "n, 3"]
    conics: Annotated[FloatArray, "n, 3"]
    opacities: Annotated[FloatArray, "n"]  # activated, and compensated where antialiased


class CenterGradients(NamedTuple):
    """Gradients of the 2D means of visible Gaussians, packed."""

    centers: Annotated[FloatOutput, "sums.M if with_centers else 0, 2"]
    absolute: Annotated[FloatOutput, "sums.M if absgrad else 0, 2"]  # |v_means2d| summed over pixels, added to


@worker(
    file="splat_adjoint.h",
    items="(n + BLOCK - 1) / BLOCK",
    grain="1",
    structs=(Channels, ProjectedGradients, RowList, SplatGradients),
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
    antialiased: int,
    with_centers: int,
    absgrad: int,
    parts: int,
    optimizations: int,
) -> None: ...
