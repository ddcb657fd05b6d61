"""A CPU rasterizer for 3D Gaussians with gsplat's signature.

Its kernels are C++ with vector types (`kernels/*.h`), which NVIDIA Warp's own Clang compiles, so no compiler has to be
installed. Warp launches them on all cores. No kernel is written in Warp's Python dialect. Warp is imported and kernels
are compiled when something is first rendered, or on spare threads by `load_kernels_ahead`. Compilation takes seconds,
and the result is cached on disk.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from skipgs_plug.lazy import attach

if TYPE_CHECKING:
    from .ahead import load_kernels_ahead
    from .install import install_as_gsplat
    from .oracle.torch_reference_projection import spherical_harmonics
    from .rasterize import rasterization
    from .runtime.buffers import release_memory
    from .runtime.cores import usable_cores
    from .runtime.threads import get_num_threads, set_num_threads
    from .splats import rasterize_splats
    from .stages.rows import take_rows
    from .training.adam import adam_rows
    from .training.gradient_norms import sum_norms
    from .training.lazy_adam import LazyAdam
    from .training.loss import l1_ssim_loss
    from .training.optimizer import ADAM_REPLACED, Adam, instead_of_torchs_adam, moments

__all__ = [
    "ADAM_REPLACED",
    "Adam",
    "LazyAdam",
    "adam_rows",
    "get_num_threads",
    "install_as_gsplat",
    "instead_of_torchs_adam",
    "l1_ssim_loss",
    "load_kernels_ahead",
    "moments",
    "rasterization",
    "rasterize_splats",
    "release_memory",
    "set_num_threads",
    "spherical_harmonics",
    "sum_norms",
    "take_rows",
    "usable_cores",
]

# Modules are loaded on first use: a program that only asks for the number of threads should not load optimizers.
_HOMES = {
    "ADAM_REPLACED": "training.optimizer",
    "Adam": "training.optimizer",
    "LazyAdam": "training.lazy_adam",
    "adam_rows": "training.adam",
    "get_num_threads": "runtime.threads",
    "install_as_gsplat": "install",
    "instead_of_torchs_adam": "training.optimizer",
    "l1_ssim_loss": "training.loss",
    "load_kernels_ahead": "ahead",
    "moments": "training.optimizer",
    "rasterization": "rasterize",
    "rasterize_splats": "splats",
    "release_memory": "runtime.buffers",
    "set_num_threads": "runtime.threads",
    "spherical_harmonics": "oracle.torch_reference_projection",
    "sum_norms": "training.gradient_norms",
    "take_rows": "stages.rows",
    "usable_cores": "runtime.cores",
}

__getattr__, __dir__ = attach(__name__, _HOMES)
