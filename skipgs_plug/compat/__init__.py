"""CPU stand-ins for the CUDA extension modules that trainers of the Inria family import.

They offer every rasterizer signature, `simple_knn` and `fused_ssim`, computed by the rasterizer of this package. They
differ from CUDA in four points. Alpha is capped at 0.999 and not at 0.99. A Gaussian whose opacity is below 1/255 does
not count as drawn. Precomputed 3D covariances are refused. Everything is slower.
"""

from .serve import FAMILIES, serve

__all__ = ["FAMILIES", "serve"]
