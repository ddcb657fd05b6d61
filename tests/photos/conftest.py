"""Photographs of a real scene, and others that do not belong to it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from PIL import Image, ImageFilter


@pytest.fixture(scope="session")
def fern(shared: Path) -> list[Path]:
    """Twenty photographs, 252x189."""
    return sorted((shared / "data/fern/images_2").glob("*.png"))


@pytest.fixture
def photos(fern: list[Path], shared: Path, tmp_path: Path) -> Path:
    """Eight photographs of fern, one that is blurred and one of another place."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for path in fern[:8]:
        shutil.copy(path, folder)
    Image.open(fern[9]).filter(ImageFilter.GaussianBlur(8)).save(folder / "blurred.png")
    (elsewhere, *_) = sorted((shared / "data/bonsai/images").iterdir())
    Image.open(elsewhere).resize((252, 189), Image.Resampling.LANCZOS).save(folder / "elsewhere.png")
    return folder
