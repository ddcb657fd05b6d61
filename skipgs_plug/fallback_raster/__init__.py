"""A CPU rasterizer for 3D Gaussians with gsplat's signature.

Its kernels are C++ with vector types (`kernels/*.h`), compiled by NVIDIA Warp's own Clang and launched by Warp on all
cores; none is written in Warp's Python dialect, and no compiler has to be installed. Warp is imported, and kernels are
compiled (seconds, cached on disk), when something is first rendered.
"""

from .install import install_as_gsplat as install_as_gsplat
from .loss import l1_ssim_loss as l1_ssim_loss
from .rasterization import rasterization as rasterization
from .threads import get_num_threads as get_num_threads
from .threads import set_num_threads as set_num_threads
