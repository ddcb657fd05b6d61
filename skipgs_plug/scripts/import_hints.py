"""Explain how to install a module that a script imports and that is missing."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from pathlib import Path

# Modules that every checkout of the Inria family contains.
OF_CHECKOUTS = frozenset({"arguments", "gaussian_renderer", "scene", "utils"})
EXTENSIONS = ("diff_", "simple_knn", "fused_ssim")
# Packages of the package index by the name of their module: where the two differ, and those that Inria's checkout lists
# for conda.
PACKAGES = {
    "cv2": "opencv-python",
    "PIL": "pillow",
    "plyfile": "plyfile",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "tqdm": "tqdm",
    "yaml": "pyyaml",
}
ENVIRONMENTS = (".yml", ".yaml")  # endings of files that list packages for conda
REQUIREMENTS = ("*requirements*.txt", "environment*.yml", "environment*.yaml", "pyproject.toml", "setup.*")
# Number of folders that are searched for requirements, from the script's folder upwards. gsplat keeps its scripts one
# folder below its checkout.
FOLDERS = 2
# Parts of a requirements file that list nothing: comments, and the name of the checkout or environment itself.
UNLISTED = re.compile(r"""#.*|\bname["']?\s*[=:]\s*["']?[\w.-]+""")


def is_extension(module: str) -> bool:
    """Return whether a module is named like a CUDA extension of a trainer."""
    return module.startswith(EXTENSIONS)


def install_hint(module: str, script: Path, stand_ins: Container[str] = ()) -> str:
    """Return a sentence that explains how to install a missing module.

    The sentence names a package only if the requirements of the checkout list it or if `PACKAGES` holds the module.
    Any other module may be a file that the checkout lacks, and the package index may hold an unrelated package of
    that name. So may it for an entry with a folder or an address, such as `submodules/simple-knn`, and for a package of
    conda.

    Args:
        module: Name of the missing module.
        script: File of the script that imports the module.
        stand_ins: Modules that `--cpu` replaces for this trainer.
    """
    top = module.partition(".")[0]
    if top in OF_CHECKOUTS:
        return f"{script.name} is not in its checkout: its folder has no {top}. Run the script in a complete checkout."
    if is_extension(top):
        cpu = ", or run on the CPU with --cpu before '--'" if top in stand_ins else ""
        return f"{top} is a CUDA extension of the trainer: build it as the trainer's README says{cpu}."
    package = PACKAGES.get(top, top)
    for listing in requirements(script):
        listed = listing.read_text(errors="replace")
        entry = entry_of(listed, package)
        if entry is not None and "/" in entry:
            return (
                f"{script.name} needs the module {top}, which {listing.name} takes from {entry}: install it from "
                "there, as the trainer's README says."
            )
        for_conda = listing.suffix in ENVIRONMENTS and is_for_conda(listed, package)
        if entry is not None and top not in PACKAGES and for_conda:
            return (
                f"{script.name} needs the package {package}, which {listing.name} lists for conda: install it from "
                "there, or with pip under the name that its own page gives."
            )
        if entry is not None:
            return f"{script.name} needs the package {package}, which {listing.name} lists; run: pip install {package}"
    if top in PACKAGES:
        return f"{script.name} needs the module {top}; run: pip install {package}"
    return (
        f"{script.name} needs the module {module}, which is not installed and not in its folder. If {module} is part "
        "of the checkout, fetch the whole checkout; otherwise install the package that the trainer's README names."
    )


def requirements(script: Path) -> Iterator[Path]:
    """Yield the requirement files in the folder of a script and above it, `FOLDERS` folders in all."""
    for folder in (script.parent, *script.parents[1:FOLDERS]):
        for pattern in REQUIREMENTS:
            yield from sorted(path for path in folder.glob(pattern) if path.is_file())


def is_for_conda(environment: str, package: str) -> bool:
    """Return whether an environment lists a package for conda, not for pip, whose index may not know that name."""
    return entry_of(environment.partition("pip:")[2], package) is None


def entry_of(listing: str, package: str) -> str | None:
    """Return the entry of a list of requirements that names a package; None without one.

    Package indices treat "-" and "_" alike. A plain name is preferred to a folder or an address.
    """
    name = re.sub("[-_]+", "[-_]", re.escape(package).replace(r"\-", "-"))
    pattern = rf"[^\s\"']*(?<![\w-]){name}(?![\w-])(?:[ \t]*@[ \t]*)?[^\s\"',]*"
    found = re.findall(pattern, UNLISTED.sub("", listing), re.IGNORECASE)
    return min(found, key=lambda entry: "/" in entry, default=None)
