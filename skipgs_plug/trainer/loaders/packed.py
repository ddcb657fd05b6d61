"""Packed scenes: one .npz with PNG-encoded images, readable with numpy and Pillow alone."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.files import write_aside
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.scene import BLACK, Scene, View, assemble_scene

VERSION = 1


def save_packed(scene: Scene, path: str | Path) -> None:
    """Write the scene, images as lossless PNG bytes, split and background included."""
    views = scene.train + scene.test
    encoded = [encode_png(view) for view in views]
    content = {
        "version": np.int64(VERSION),
        "name": np.array(scene.name),
        "n_train": np.int64(len(scene.train)),
        "view_names": np.array([view.name for view in views]),
        "Ks": torch.stack([view.K for view in views]).numpy(),
        "viewmats": torch.stack([view.viewmat for view in views]).numpy(),
        "image_bytes": np.frombuffer(b"".join(encoded), dtype=np.uint8),
        "image_sizes": np.array([len(data) for data in encoded], dtype=np.int64),
        "points": scene.points.numpy(),
        "points_rgb": scene.points_rgb.numpy(),
        "background": np.array(scene.background, dtype=np.float64),
    }
    with write_aside(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **content)


def load_packed(path: Path) -> Scene:
    """Read what `save_packed` wrote."""
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
            content = {key: archive[key] for key in archive.files}
        if int(content["version"]) != VERSION:
            raise InputError(
                f"Packed scene {path} has version {content['version']}, expected {VERSION}; pack it again."
            )
        ends = np.cumsum(content["image_sizes"])
        data = content["image_bytes"].tobytes()
        views = []
        for i, name in enumerate(content["view_names"]):
            png = io.BytesIO(data[ends[i] - content["image_sizes"][i] : ends[i]])
            pixels, _ = read_image(png, f"{name} in {path}", BLACK)
            K, viewmat = (torch.from_numpy(content[key][i].astype(np.float32)) for key in ("Ks", "viewmats"))
            views.append(View(str(name), pixels, K, viewmat))
        n_train = int(content["n_train"])
        background = tuple(float(channel) for channel in content["background"])
        points, points_rgb, name = content["points"], content["points_rgb"], str(content["name"])
    except (KeyError, IndexError, ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"Packed scene {path} is damaged or not one ({error}); pack it again.") from error
    return assemble_scene(path, name, views[:n_train], views[n_train:], points, points_rgb, background)  # type: ignore[arg-type]


def encode_png(view: View) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(view.image.numpy()).save(stream, format="PNG")
    return stream.getvalue()
