"""`skipgs-plug doctor`: try which backends and extras work on this machine."""

from __future__ import annotations

import importlib
import importlib.metadata
import platform
import sys

import torch

from skipgs_plug.commands.backend_probe import try_backend
from skipgs_plug.install import install_command

# import name, distribution, purpose
EXTRAS = (
    ("warp", "warp-lang", "rasterizer on the CPU"),
    ("gsplat", "gsplat", "densification, rasterizer on CUDA"),
    ("PIL.Image", "pillow", "images"),
    ("pycolmap", "pycolmap", "COLMAP scenes"),  # after Pillow, see IMPORT_ORDER
    ("plyfile", "plyfile", "PLY"),
    ("scipy", "scipy", "initial scales"),
    ("tyro", "tyro", "command line"),
    ("filelock", "filelock", "one process per run folder"),
    ("tqdm", "tqdm", "progress bar"),
    ("yaml", "pyyaml", "cfg.yml"),
    ("torchmetrics", "torchmetrics", "LPIPS"),
    ("matplotlib", "matplotlib", "plots"),
    ("jinja2", "jinja2", "report"),
    ("imageio_ffmpeg", "imageio-ffmpeg", "videos"),
    ("viser", "viser", "view"),
    ("tensorboard", "tensorboard", "--tensorboard"),
)

# This is not tried here, since the wrong order crashes the process or hangs it in pycolmap's crash handler.
IMPORT_ORDER = """
      In scripts of your own, import PIL.Image before pycolmap, as this package does. In the other order
      Pillow is bound to the zlib of pycolmap (seen with 4.2.1), and the first PNG that is saved ends the process."""


def run(args: None) -> int:
    """Print the results. Return 0 if a backend renders here, else 1."""
    cuda = torch.cuda.get_device_name() if torch.cuda.is_available() else "no CUDA device"
    print(f"Python {platform.python_version()}, torch {torch.__version__}, {cuda}, {torch.get_num_threads()} threads")
    print("\nPackages")
    missing = [check_package(*extra) for extra in EXTRAS].count(False)
    if "PIL.Image" in sys.modules and "pycolmap" in sys.modules:
        print(IMPORT_ORDER)
    print("\nBackends")
    works = [check_backend(name) for name in ("gsplat", "warp")]
    if torch.cuda.is_available():
        print("\nMeasure the gate on this GPU, from a checkout, in eight minutes: python -m benchmarks.gpu SCENE")
    if missing:
        print(f"\nGet all missing packages with: {install_command()}")
    return 0 if any(works) else 1


def check_package(module: str, distribution: str, purpose: str) -> bool:
    try:
        importlib.import_module(module)
    except Exception as error:  # a broken installation may fail with any error
        reason = "missing" if isinstance(error, ModuleNotFoundError) else f"broken ({error})"
        report(False, distribution, f"{reason}, for: {purpose}; run: pip install {distribution}")
        return False
    report(True, distribution, f"{importlib.metadata.version(distribution)}, for: {purpose}")
    return True


def check_backend(name: str) -> bool:
    """Try a backend and print the result, even if native code crashes."""
    works, finding = try_backend(name)
    report(works, name, finding)
    return works


def report(works: bool, name: str, finding: str) -> None:
    print(f"  {'ok' if works else '--'}  {name:13} {finding}", file=sys.stdout)
