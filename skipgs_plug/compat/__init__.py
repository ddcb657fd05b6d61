"""CPU stand-ins for the CUDA extension modules that the Inria family of trainers imports.

Every rasterizer signature, `simple_knn` and `fused_ssim`, computed by the rasterizer of this package.
What differs from CUDA: alpha is capped at 0.999 instead of 0.99, a Gaussian below 1/255 opacity counts as
not drawn, precomputed 3D covariances are refused, and nothing is fast.
"""

from .serve import FAMILIES, serve

__all__ = ["FAMILIES", "serve"]
