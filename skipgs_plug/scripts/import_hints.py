"""What to do about a module that a script asks for and that is not there."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterator
from pathlib import Path

# Parts of every checkout of the Inria family, CUDA extensions, packages not called as their module.
OF_CHECKOUTS = frozenset({"arguments", "gaussian_renderer", "scene", "utils"})
EXTENSIONS = ("diff_", "simple_knn", "fused_ssim")
# What the stand-ins take arguments with.
RASTERIZER = re.compile(r"GaussianRaster\w+|\bsplats\(\)")
PACKAGES = {
    "cv2": "opencv-python",
    "PIL": "pillow",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "yaml": "pyyaml",
}
REQUIREMENTS = ("*requirements*.txt", "environment*.yml", "environment*.yaml", "pyproject.toml", "setup.*")
FOLDERS = 2  # gsplat's scripts lie one below the folder of its checkout


def what_brings(module: str, script: Path, on_cpu: bool = False) -> str:
    """A sentence for a module that a script asks for and that is not there.

    It names a package only where the checkout's requirements do, or the name of the module is known to differ from
    that of its package: modules are also files that a checkout lacks, and indices hold packages of any name.
    """
    top = module.partition(".")[0]
    if top in OF_CHECKOUTS:
        return f"{script.name} is not in its checkout: there is no {top} beside it; run the one in a whole checkout."
    if top.startswith(EXTENSIONS) and on_cpu:
        return (
            f"{top} is a CUDA extension that has no CPU stand-in under this adapter: name the adapter of the "
            "trainer that it belongs to, or run with CUDA, without --cpu."
        )
    if top.startswith(EXTENSIONS):
        return (
            f"{top} is a CUDA extension that comes with the trainer: build it as the trainer's README says, or run on "
            "the CPU with --cpu before '--'."
        )
    package = PACKAGES.get(top, top)
    for listing in requirements(script):
        if names(listing, package):
            return f"{script.name} needs the package {package}, which {listing.name} lists; run: pip install {package}"
    if top in PACKAGES:
        return f"{script.name} needs the module {top}; run: pip install {package}"
    return (
        f"{script.name} needs the module {module}, which is neither installed nor beside it: if it is a file of the "
        "script's checkout, take a whole checkout; else install the package that the trainer's README names."
    )


def foreign_rasterizer(error: BaseException) -> str | None:
    """Return a sentence for a script that calls its rasterizer in a way that the CPU stand-in does not know.

    Returns:
        None for any other error.
    """
    text, last = str(error), traceback.extract_tb(error.__traceback__)[-1:]
    found = None
    if isinstance(error, ModuleNotFoundError):
        return None
    if isinstance(error, ImportError) and error.name and error.name.startswith(EXTENSIONS):
        found = text.partition(" (")[0]
    elif isinstance(error, TypeError) and RASTERIZER.search(text):
        found = text
    elif isinstance(error, ValueError) and "to unpack" in text and "gaussian_renderer" in last[0].filename:
        found = f"{text} where the renderer takes its results"
    if found is None:
        return None
    return (
        f"The script has a rasterizer of its own, which --cpu has no stand-in for ({found}): run it with CUDA, without "
        "--cpu."
    )


def requirements(script: Path) -> Iterator[Path]:
    """Yield the files near a script that list what it needs."""
    for folder in (script.parent, *script.parents[1:FOLDERS]):
        for pattern in REQUIREMENTS:
            yield from sorted(path for path in folder.glob(pattern) if path.is_file())


def names(listing: Path, package: str) -> bool:
    """Whether a list of requirements names a package; to indices "-" and "_" are one."""
    name = re.sub("[-_]+", "[-_]", re.escape(package).replace(r"\-", "-"))
    return re.search(rf"(?<![\w-]){name}(?![\w-])", listing.read_text(errors="replace"), re.IGNORECASE) is not None
