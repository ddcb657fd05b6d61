"""Measures pictures of held-out views that other projects' scripts have written."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from skipgs_plug.trainer.metrics import chosen, measure


def find_pictures(out: Path) -> Path:
    """Return the newest folder of pictures in a script's output, as `measure_pictures` takes it.

    Raises:
        FileNotFoundError: The script has written none.
    """
    folders = [path.parent for path in out.rglob("gt") if path.is_dir()] + list(out.glob("renders"))
    if not folders:
        raise FileNotFoundError(f"There are no pictures of held-out views in {out}.")
    return max(folders, key=lambda path: path.stat().st_mtime)


def measure_pictures(folder: Path, lpips_net: str | None = None, device: str = "cpu") -> dict[str, Any]:
    """Return means of PSNR, SSIM and, for a backbone, LPIPS over pictures, and their number.

    Renders and photographs lie in folders `renders` and `gt` (Inria's family), or side by side in one file (gsplat,
    nerfstudio).
    """
    if (folder / "gt").is_dir():
        names = sorted(path.name for path in (folder / "gt").iterdir())
        pairs = [(pixels(folder / "renders" / name, device), pixels(folder / "gt" / name, device)) for name in names]
    else:
        pairs = []
        for path in sorted([*folder.glob("val_step*.png"), *folder.glob("eval_img_*.png")]):
            photograph, render = pixels(path, device).chunk(2, dim=1)
            pairs.append((render.contiguous(), photograph.contiguous()))
    return means([measure(chosen(lpips_net), render, photograph) for render, photograph in pairs])


def pixels(path: Path, device: str = "cpu") -> Tensor:
    """Return a picture as a tensor [H, W, 3] in [0, 1]."""
    return torch.from_numpy(np.array(Image.open(path).convert("RGB"))).to(device).float() / 255


def means(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Return means by name, and the number of views."""
    return {**{name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}, "views": len(rows)}
