"""Cache of undistorted photographs in their scene: undistorting takes several times as long as reading."""

from __future__ import annotations

import hashlib
import json
import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, PngImagePlugin
from torch import Tensor

from skipgs_plug.files import WriteError
from skipgs_plug.trainer.files import write_aside
from skipgs_plug.trainer.loaders.native import import_pycolmap

log = logging.getLogger(__name__)

FOLDER = "undistorted_cache"
VERSION = "1"  # part of each hash: files of another version are not found
CAMERA = "pinhole"  # text entry of the PNG that holds the calibration matrix


class Straight(NamedTuple):
    """A photograph without lens distortion."""

    pixels: Tensor  # [H, W, 3] uint8
    mask: Tensor | None  # [H, W] bool
    K: np.ndarray  # [3, 3]


class UndistortedCache:
    """One PNG per photograph in a folder of the scene, named by a hash of everything that it depends on.

    So the cache is never out of date and may be deleted at any time. If it cannot be written, there is one warning, and
    distortion is removed at each load.
    """

    def __init__(self, scene: Path) -> None:
        self.folder = scene / FOLDER
        self._writable = True

    def key(self, image_path: Path, mask_path: Path | None, camera: Any, factor: int) -> str:
        """Return the key of a photograph."""
        digest = hashlib.sha256()
        description = camera.todict() | {"camera_id": 0, "has_prior_focal_length": False}
        for part in (VERSION, import_pycolmap().__version__, str(factor), str(sorted(description.items(), key=str))):
            digest.update(part.encode() + b"\0")
        for path in (image_path, mask_path):
            content = path.read_bytes() if path is not None else b""
            digest.update(str(len(content)).encode() + b"\0" + content)
        return digest.hexdigest()[:32]

    def read(self, key: str) -> Straight | None:
        """Return the entry of a key; None if it does not exist or its file is damaged."""
        path = self.folder / f"{key}.png"
        if not path.is_file():
            return None
        try:
            with Image.open(path) as opened:
                pixels = torch.from_numpy(np.array(opened))  # [H, W, 3 or 4]
                K = np.array(json.loads(opened.info[CAMERA]), dtype=np.float64).reshape(3, 3)
        except Exception as error:  # Pillow raises many kinds of errors on damaged files
            log.debug("%s cannot be read (%s) and is written anew.", path, error)
            return None
        if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or not np.isfinite(K).all():
            return None
        mask = pixels[..., 3] >= 128 if pixels.shape[2] == 4 else None
        return Straight(pixels[..., :3].contiguous(), mask, K)

    def write(self, key: str, straight: Straight) -> None:
        """Write a photograph, unless the folder cannot be written."""
        if not self._writable:
            return
        pixels = straight.pixels.numpy()
        if straight.mask is not None:
            pixels = np.concatenate([pixels, straight.mask.byte().numpy()[..., None] * 255], axis=2)
        info = PngImagePlugin.PngInfo()
        info.add_text(CAMERA, json.dumps(straight.K.tolist()))
        try:
            with write_aside(self.folder / f"{key}.png", pixels.nbytes) as temporary:
                Image.fromarray(pixels).save(temporary, format="PNG", compress_level=1, pnginfo=info)
        except WriteError as error:
            self._writable = False
            log.warning("%s Lens distortion is removed anew at each load.", error)
