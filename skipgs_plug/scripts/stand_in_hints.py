"""Explains errors of scripts that use a name, an argument or an output that the CPU stand-ins lack."""

from __future__ import annotations

import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from skipgs_plug.scripts.import_hints import is_extension

PACKAGES = ("skipgs_plug.compat", "skipgs_plug.fallback_raster")  # packages of the stand-ins and their rasterizer
FOLDERS = tuple(Path(__file__).parents[1] / package.rpartition(".")[2] for package in PACKAGES)
# Beginning of the message of a `TypeError`, if a call has other arguments than the function.
SIGNATURE = re.compile(r"([\w.]+)\(\) (got|takes|missing) ")
CUDA_WRAPPERS = ("gsplat", "cuda")  # folder whose functions need the extension, with or without a toolkit to compile it
# Modules that stand-ins replace only where torchvision cannot be imported, as messages name them.
WITH_TORCHVISION = ("torchvision", "lpips")
SHAPE = " must have shape "  # in the message of the stand-ins' rasterizer for a tensor that does not fit the others


def stand_in_hint(error: BaseException) -> str | None:
    """Return a sentence that explains the error of a script that needs more than the CPU stand-ins have.

    A stand-in can lack a name, an argument or an output, or refuse an option. A CUDA extension can have none.

    Returns:
        The sentence; None for any other error.
    """
    frames = traceback.extract_tb(error.__traceback__)
    if name := called_with_cuda(frames):
        return f"The script calls {name}(), for which --cpu has no stand-in: it needs CUDA; run it without --cpu."
    text, last = str(error), frames[-1:]
    inside = bool(last) and any(folder in Path(last[0].filename).parents for folder in FOLDERS)
    lacks = False
    if isinstance(error, NotImplementedError) and inside:
        return text
    if isinstance(error, OSError) and "CUDA_HOME" in text:  # of `torch.utils.cpp_extension`
        return (
            "The script compiles a CUDA extension of its own, for which this adapter has no CPU stand-in: run it on a "
            "GPU, without --cpu."
        )
    if isinstance(error, AttributeError):
        lacks = is_stand_in(error.obj)
    elif isinstance(error, ImportError) and error.name:  # a stand-in lacks a name or a module
        lacks = any(is_stand_in(sys.modules.get(name)) for name in (error.name, error.name.rpartition(".")[0]))
        if not lacks and isinstance(error, ModuleNotFoundError) and is_extension(error.name):
            top = error.name.partition(".")[0]
            return (
                f"{top} is a CUDA extension for which this adapter has no CPU stand-in: run the script on a GPU, "
                "without --cpu."
            )
        text = text.partition(" (")[0]
    elif isinstance(error, TypeError) and (call := SIGNATURE.match(text)):
        lacks = inside or call[1].partition(".")[0] in callables()
    elif isinstance(error, IndexError):
        lacks = is_stand_in(error)
    elif isinstance(error, ValueError) and inside and SHAPE in text:  # extensions of forks return other shapes
        return (
            f"The script gives the stand-ins of --cpu a tensor of another shape than they take ({text.rstrip('.')}): "
            "if it trains with CUDA, its own CUDA extensions return or take other shapes; run it without --cpu."
        )
    elif isinstance(error, ValueError) and "to unpack" in text:
        lacks = "gaussian_renderer" in last[0].filename
        text += " where the renderer unpacks the outputs"
    if not lacks:
        return None
    if any(name in text for name in WITH_TORCHVISION):
        need = "it needs torchvision; install the version of torchvision that belongs to this PyTorch."
    else:
        need = "it needs CUDA; run it without --cpu."
    return f"The script uses a feature that the stand-ins of --cpu lack ({text}): {need}"


def called_with_cuda(frames: Sequence[traceback.FrameSummary]) -> str:
    """Return the full name of the function of gsplat that the script called, if CUDA code of it failed; else ""."""
    files = [Path(frame.filename) for frame in frames]
    first = next((index for index, file in enumerate(files) if file.parts[-3:-1] == CUDA_WRAPPERS), None)
    if first is None:
        return ""
    package = files[first].parents[1]
    while first and package in files[first - 1].parents:  # the script itself may run in a function of gsplat, `cli`
        first -= 1
    module = files[first].relative_to(package.parent).with_suffix("").parts
    return ".".join((*module, frames[first].name))


def is_stand_in(thing: Any) -> bool:
    """Return whether this is a module or class of the stand-ins, or an object of such a class."""
    kind = thing if isinstance(thing, type) else type(thing)
    return kind.__module__.startswith(PACKAGES)


def callables() -> Iterator[str]:
    """Yield the names of the stand-ins' classes and functions, with which messages of a `TypeError` begin."""
    for module in [module for module in sys.modules.values() if is_stand_in(module)]:
        for value in vars(module).values():
            kinds = value.__mro__ if isinstance(value, type) else (value,)
            yield from (kind.__name__ for kind in kinds if str(getattr(kind, "__module__", "")).startswith(PACKAGES))
