"""Stand-in for the branch `3dgs_accel` of Inria's rasterizer: the current version, and a sparse Adam."""

from .inria import GaussianRasterizationSettings, GaussianRasterizer
from .sparse_adam import SparseGaussianAdam

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam"]
