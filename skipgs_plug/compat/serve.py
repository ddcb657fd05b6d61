"""Serves the stand-ins where a trainer's `import` finds them, while the trainer runs."""

from __future__ import annotations

import functools
import importlib
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.machinery import ModuleSpec
from types import ModuleType

from .child_processes import also_in_children
from .nvidia_smi import one_free_gpu
from .packages import reported_missing, usable

_CLASSES = ("GaussianRasterizationSettings", "GaussianRasterizer")
_ACCELERATED = (*_CLASSES, "SparseGaussianAdam")
_Source = dict[str, tuple[str, tuple[str, ...]]]  # module name -> our module, and the names that it offers

_KNN: _Source = {"simple_knn": (".knn", ()), "simple_knn._C": (".knn", ("distCUDA2",))}
_SSIM: _Source = {"fused_ssim": (".ssim", ("fused_ssim",))}
_RASTERIZER = "diff_gaussian_rasterization"
_PIP = "gaussian_splatting."  # the pip package contains its extensions

FAMILIES: dict[str, _Source] = {
    "inria": {_RASTERIZER: (".inria", _CLASSES), **_KNN, **_SSIM},
    # train.py recognises the branch `3dgs_accel` of the rasterizer by SparseGaussianAdam.
    "inria_accelerated": {_RASTERIZER: (".inria_accelerated", _ACCELERATED), **_KNN, **_SSIM},
    "fastgs": {f"{_RASTERIZER}_fastgs": (".fastgs", _ACCELERATED), **_KNN, **_SSIM},
    "taming": {_RASTERIZER: (".taming", _ACCELERATED), **_KNN, **_SSIM},
    "speedy_splat": {_RASTERIZER: (".speedy_splat", _CLASSES), **_KNN},
    "lightgaussian": {_RASTERIZER: (".lightgaussian", _CLASSES), **_KNN},
    "gaussianspa": {
        f"{_RASTERIZER}_ms": (".gaussianspa", _CLASSES),
        _RASTERIZER: (".inria", _CLASSES),
        **_KNN,
    },
    "mcmc": {_RASTERIZER: (".mcmc", (*_CLASSES, "compute_relocation")), **_KNN},
    "mip_splatting": {_RASTERIZER: (".mip_splatting", _CLASSES), **_KNN},
    "absgs": {f"{_RASTERIZER}_abs": (".absgs", _CLASSES), **_KNN},
    "pixel_gs": {_RASTERIZER: (".pixel_gs", _CLASSES), **_KNN},
    "scaffold_gs": {
        _RASTERIZER: (".scaffold_gs", _CLASSES),
        "torch_scatter": (".scaffold_gs", ("scatter_max",)),
        **_KNN,
    },
    "dash_gaussian": {_RASTERIZER: (".inria_accelerated", _ACCELERATED), **_KNN, **_SSIM},
    "improved_gs": {_RASTERIZER: (".improved_gs", _ACCELERATED), **_KNN, **_SSIM},
    "pip_gaussian_splatting": {
        f"{_PIP}{_RASTERIZER}": (".inria", _CLASSES),
        f"{_PIP}simple_knn": (".knn", ()),
        f"{_PIP}simple_knn._C": (".knn", ("distCUDA2",)),
        **_SSIM,
    },
    "gsplat": _SSIM,
    "nerfstudio": {},  # gsplat contains all CUDA code that splatfacto needs
}
# Modules that are also served if torchvision cannot be imported: LPIPS of pip, and the copy that most trainers bring.
_WITHOUT_TORCHVISION: _Source = {
    "lpips": (".lpips", ("LPIPS",)),
    "lpips.lpips": (".lpips", ("LPIPS",)),
    "lpipsPyTorch": (".lpips", ("LPIPS", "lpips")),
}


@contextmanager
def serve(family: str) -> Iterator[None]:
    """Serve the extension modules of one family of trainers with the CPU rasterizer, inside the `with` statement.

    Processes that are spawned there are served too. If torchvision cannot be imported, the few functions of it that
    these trainers call are also served. Modules of the same names that were imported before are restored at the end.

    Args:
        family: A key of `FAMILIES`.

    Raises:
        ValueError: The family is unknown.
    """
    if family not in FAMILIES:
        raise ValueError(f"No stand-ins for {family!r}; there are some for: {', '.join(sorted(FAMILIES))}.")
    served = {name: _module(name, *source) for name, source in FAMILIES[family].items()}
    in_part: dict[str, ModuleType] = {}
    # gsplat's script has no use for torchvision.
    if family != "gsplat" and not usable("torchvision"):
        in_part = importlib.import_module(".vision", __package__).modules()
        served |= {name: _module(name, *source) for name, source in _WITHOUT_TORCHVISION.items()}
        served |= in_part
    before = {name: sys.modules.get(name) for name in served}
    try:
        # `_extras` first: it imports torchmetrics, which must not find the served part of torchvision.
        with _extras(family):
            sys.modules.update(served)
            with reported_missing(in_part), also_in_children(functools.partial(serve, family)):
                yield
    finally:
        for name, module in before.items():
            if module is None:
                sys.modules.pop(name, None)
            else:
                sys.modules[name] = module


def _extras(family: str) -> AbstractContextManager[None]:
    """Return further replacements that a family needs besides modules."""
    if family in ("gsplat", "nerfstudio"):  # gsplat is a real package here: its functions are replaced
        from .gsplat_script import gsplat_on_cpu

        return gsplat_on_cpu()
    return one_free_gpu() if family == "scaffold_gs" else nullcontext()


class StandIn(ModuleType):
    """A module that a trainer imports in place of a CUDA module. Its class tells errors of its users from others."""


def _module(name: str, source: str, offered: tuple[str, ...]) -> ModuleType:
    module = StandIn(name, f"CPU stand-in for {name}, served by skipgs_plug.")
    module.__spec__ = ModuleSpec(name, None)  # scripts ask `importlib.util.find_spec` whether an extension is there
    ours = importlib.import_module(source, __package__)
    for attribute in offered:
        setattr(module, attribute, getattr(ours, attribute))
    return module
