"""Two operations of gsplat's MCMCStrategy that gsplat has only in CUDA."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import Tensor

from skipgs_plug.fallback_raster.oracle.torch_reference_projection import rotation_matrices

from .relocation import compute_relocation
from .stand_ins import stand_ins


@contextmanager
def strategy_on_cpu() -> Iterator[None]:
    """Let gsplat's MCMCStrategy run without CUDA inside the `with` statement.

    Raises:
        ImportError: gsplat is not installed.
    """
    import gsplat.strategy.ops as ops

    functions = (compute_relocation, quat_scale_to_covar_preci)
    with stand_ins([(ops, function.__name__, function) for function in functions]):
        yield


def quat_scale_to_covar_preci(
    quats: Tensor,
    scales: Tensor,
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[Tensor | None, Tensor | None]:
    """Return covariances [N, 3, 3] and their inverses [N, 3, 3], each None unless requested.

    Args:
        quats: Rotations w, x, y, z of any length. [N, 4]
        scales: Standard deviations. [N, 3]
        compute_covar: Whether to compute covariances.
        compute_preci: Whether to compute their inverses.
        triu: Not supported.

    Raises:
        NotImplementedError: `triu` is set, which gsplat's strategies do not do.
    """
    if triu:
        raise NotImplementedError("The CPU stand-in returns whole matrices: leave triu False.")
    rotation = rotation_matrices(quats)
    covariance = precision = None
    if compute_covar:
        root = rotation * scales[:, None, :]
        covariance = root @ root.transpose(-1, -2)
    if compute_preci:
        root = rotation / scales[:, None, :]
        precision = root @ root.transpose(-1, -2)
    return covariance, precision
