"""What gsplat's own `simple_trainer.py`, and nerfstudio, need on a machine without CUDA, beyond the rasterizer."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torch import Tensor

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.install import install_as_gsplat

from .lpips import AbsentLpips
from .packages import usable
from .scene_manager import SceneManager
from .stand_ins import stand_ins
from .strategy_operations import strategy_on_cpu


@contextmanager
def gsplat_on_cpu() -> Iterator[None]:
    """Replace gsplat's rasterizer and the two CUDA functions its MCMC strategy calls.

    Where torchvision is missing, torchmetrics' LPIPS is replaced too: the script builds it at the start. The pycolmap
    that is installed gets the `SceneManager` of the one that gsplat's script wants up to 1.5.3.

    Raises:
        ImportError: gsplat is not installed.
    """
    with _no_cuda_toolkit():
        import gsplat.rendering
    import torchmetrics.image.lpip

    replaced: list[tuple[Any, str, Any]] = []
    if not usable("torchvision"):
        replaced.append((torchmetrics.image.lpip, "LearnedPerceptualImagePatchSimilarity", AbsentLpips))
    if tuple(map(int, gsplat.__version__.split(".")[:2])) < (1, 5):
        replaced += [(module, "rasterization", rasterization_1_4) for module in (gsplat, gsplat.rendering)]
    if usable("PIL.Image") and usable("pycolmap"):  # in this order: the other one crashes Python later
        pycolmap = importlib.import_module("pycolmap")
        if not hasattr(pycolmap, "SceneManager"):
            replaced.append((pycolmap, "SceneManager", SceneManager))
    with install_as_gsplat(), strategy_on_cpu(), stand_ins(replaced):
        yield


@contextmanager
def _no_cuda_toolkit() -> Iterator[None]:
    """Keep gsplat from compiling its extension when it is imported, which it does since 1.6 where it finds `nvcc`."""
    if not usable("torch.utils.cpp_extension"):  # it needs setuptools, and gsplat needs it to compile
        yield
        return
    places: Any = importlib.import_module("torch.utils.cpp_extension")
    find = places._find_cuda_home
    places._find_cuda_home = lambda: None
    try:
        yield
    finally:
        places._find_cuda_home = find


@functools.wraps(rasterization)
def rasterization_1_4(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """With one radius per Gaussian, as gsplat's strategies read it before 1.5."""
    image, alpha, info = rasterization(*args, **kwargs)
    return image, alpha, info | {"radii": info["radii"].amax(dim=-1)}
