"""Spherical harmonics up to degree 3 to view-dependent colour: max(0, 0.5 + sum_k basis_k(direction) * sh_k).

Real basis with the signs of 3DGS (Kerbl et al. 2023). Only Gaussians with a radius are evaluated.
"""

from typing import Annotated

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput
from .structs import FactorOutput, Harmonics, HarmonicsGradients, RowList


@worker(file="sh_forward.h", items="(n + BLOCK - 1) / BLOCK", grain="1")
def sh_forward(
    *,
    means: Annotated[FloatArray, "n, 3"],
    sh: Harmonics,
    visible: RowList,
    colors: Annotated[FloatOutput, "n, 3"],  # zero where not visible and `dense`
    n: int,
    dense: int,
) -> None: ...


@worker(file="sh_adjoint.h", items="(n + BLOCK - 1) / BLOCK", grain="1", structs=(FactorOutput,))
def sh_adjoint(
    *,
    means: Annotated[FloatArray, "n, 3"],
    sh: Harmonics,
    visible: RowList,
    colors: Annotated[FloatArray, "n, 3"],  # result of the forward pass
    v_colors: Annotated[FloatArray, "n, 3"],
    v_means: Annotated[FloatOutput, "n, 3"],
    v_sh: HarmonicsGradients,
    v_positions: Annotated[FloatOutput, "blocks(n), 3"],  # partial sums of the camera position's gradient
    n: int,
    optimizations: int,
) -> None: ...


@worker(file="sh_bands.h", items="n", grain="BLOCK")
def sh_bands(
    *,
    directions: Annotated[FloatArray, "n, FACTOR"],
    bands: Annotated[FloatOutput, "n, BANDS"],  # beside the constant one
    n: int,
    degree: int,
) -> None: ...
