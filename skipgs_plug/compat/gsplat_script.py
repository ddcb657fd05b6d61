"""Replacements that gsplat's `simple_trainer.py` and nerfstudio need without CUDA, besides the rasterizer."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torch import Tensor

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.runtime.function_modes import without_function_modes

from .lpips import AbsentLpips
from .packages import usable
from .scene_manager import SceneManager
from .stand_ins import stand_ins
from .strategy_operations import strategy_on_cpu


@contextmanager
def gsplat_on_cpu() -> Iterator[None]:
    """Replace gsplat's rasterizer and the two CUDA functions that its MCMC strategy calls.

    If torchvision is missing, torchmetrics' LPIPS is replaced too, because the script creates it at the start. Up to
    1.5.3 the script needs the `SceneManager` of another package named pycolmap. The installed pycolmap gets a stand-in
    for it.

    Raises:
        ImportError: gsplat is not installed.
        SkipGSError: It is installed, or in the checkout of a fork, and cannot be imported.
    """
    try:
        with _no_cuda_toolkit():
            import gsplat.rendering
    except ImportError as error:
        if error.name == "gsplat":
            raise
        raise SkipGSError(
            f"The trainer's gsplat cannot be imported ({error}): install what it needs, as its README says."
        ) from error
    import torchmetrics.image.lpip

    replaced: list[tuple[Any, str, Any]] = []
    if not usable("torchvision"):
        replaced.append((torchmetrics.image.lpip, "LearnedPerceptualImagePatchSimilarity", AbsentLpips))
    old = tuple(map(int, gsplat.__version__.split(".")[:2])) < (1, 5)
    rasterize = without_function_modes(rasterization_1_4 if old else rasterization)
    replaced += [(module, "rasterization", rasterize) for module in (gsplat, gsplat.rendering)]
    if usable("PIL.Image") and usable("pycolmap"):  # in this order: the reverse order crashes Python later
        pycolmap = importlib.import_module("pycolmap")
        if not hasattr(pycolmap, "SceneManager"):
            replaced.append((pycolmap, "SceneManager", SceneManager))
    with strategy_on_cpu(), stand_ins(replaced):
        yield


@contextmanager
def _no_cuda_toolkit() -> Iterator[None]:
    """Keep gsplat from compiling its CUDA extension on import, as 1.6 and later do if they find `nvcc`."""
    if not usable("torch.utils.cpp_extension"):  # without it, which needs setuptools, gsplat cannot compile
        yield
        return
    extension: Any = importlib.import_module("torch.utils.cpp_extension")
    find = extension._find_cuda_home
    extension._find_cuda_home = lambda: None
    try:
        yield
    finally:
        extension._find_cuda_home = find


@functools.wraps(rasterization)
def rasterization_1_4(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render with one radius per Gaussian in `info`, as gsplat's strategies before 1.5 expect it."""
    image, alpha, info = rasterization(*args, **kwargs)
    return image, alpha, info | {"radii": info["radii"].amax(dim=-1)}
