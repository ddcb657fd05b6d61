"""Evaluates spherical harmonics up to degree 3 as colours: max(0, 0.5 + sum_k basis_k(direction) * sh_k).

The real basis has the signs of 3DGS (Kerbl et al. 2023). Only visible Gaussians are evaluated.
"""

from typing import Annotated

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput
from .structs import BLOCKS, FactorOutput, Harmonics, HarmonicsGradients, RowList


@worker(file="sh_forward.h", items=BLOCKS, grain="1")
def sh_forward(
    *,
    means: Annotated[FloatArray, "n, 3"],
    sh: Harmonics,
    visible: RowList,
    colors: Annotated[FloatOutput, "n, 3"],  # with `dense`, zero where not visible
    n: int,
    dense: int,
) -> None: ...


@worker(file="sh_adjoint.h", items=BLOCKS, grain="1", structs=(FactorOutput,))
def sh_adjoint(
    *,
    means: Annotated[FloatArray, "n, 3"],
    sh: Harmonics,
    visible: RowList,
    colors: Annotated[FloatArray, "n, 3"],  # of the forward pass
    v_colors: Annotated[FloatArray, "n, 3"],
    v_means: Annotated[FloatOutput, "n, 3"],
    v_sh: HarmonicsGradients,
    # Partial sums by block of the gradient of the camera's position.
    v_positions: Annotated[FloatOutput, "blocks(n), 3"],
    n: int,
    optimizations: int,
) -> None: ...


@worker(file="sh_bands.h", items="n", grain="BLOCK_ROWS")
def sh_bands(
    *,
    directions: Annotated[FloatArray, "n, FACTOR_FLOATS"],
    bands: Annotated[FloatOutput, "n, HIGHER_COEFFICIENTS"],  # values of the higher basis functions
    n: int,
    degree: int,
) -> None: ...
