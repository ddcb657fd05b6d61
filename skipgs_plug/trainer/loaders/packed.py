"""Packed scenes: one .npz with PNG-encoded images, readable with numpy and Pillow alone."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from skipgs_plug.trainer.errors import InputError, reason
from skipgs_plug.trainer.files import write_aside
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.scene import Scene, View, assemble_scene

VERSION = 1  # version of the format; a file with another one is refused
# 256 MiB, in bytes. A larger array that is compressed to less than a twentieth is refused: photographs and points do
# not compress that far, and a damaged or hostile file could request any amount of memory.
BOMB = 1 << 28
SHAPES: dict[str, tuple[int | None, ...]] = {  # None: any length; the number of views is checked separately
    "version": (),
    "name": (),
    "n_train": (),
    "view_names": (None,),
    "Ks": (None, 3, 3),
    "viewmats": (None, 4, 4),
    "image_bytes": (None,),
    "image_sizes": (None,),
    "points": (None, 3),
    "points_rgb": (None, 3),
    "background": (3,),
}
KINDS = {
    "name": "U",
    "view_names": "U",
    "Ks": "f",
    "viewmats": "f",
    "points": "f",
    "background": "f",
}  # all others are integers


def save_packed(scene: Scene, path: str | Path) -> None:
    """Write a scene into one .npz file, split and background included; `load_scene` reads it.

    Images are stored as PNG without loss, masks as their alpha channel.

    Examples:
        >>> import tempfile
        >>> from skipgs_plug.trainer import load_scene, save_packed
        >>> from skipgs_plug.trainer.synthetic import make_scene
        >>> folder = tempfile.TemporaryDirectory()
        >>> scene = make_scene(n_views=10, width=32, height=24, n_points=160)
        >>> save_packed(scene, f"{folder.name}/small.npz")
        >>> bool((load_scene(f"{folder.name}/small.npz").points == scene.points).all())
        True
        >>> folder.cleanup()
    """
    views = scene.train + scene.test
    encoded = [encode_png(view) for view in views]
    content: dict[str, Any] = {
        "version": np.int64(VERSION),
        "name": np.array(scene.name),
        "n_train": np.int64(len(scene.train)),
        "view_names": np.array([view.name for view in views]),
        "Ks": torch.stack([view.K for view in views]).numpy(),
        "viewmats": torch.stack([placed(scene, view) for view in views]).numpy(),
        "image_bytes": np.frombuffer(b"".join(encoded), dtype=np.uint8),
        "image_sizes": np.array([len(data) for data in encoded], dtype=np.int64),
        "points": points_of(scene),
        "points_rgb": scene.points_rgb.numpy(),
        "background": np.array(scene.background, dtype=np.float64),
    }
    with write_aside(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **content)


def placed(scene: Scene, view: View) -> torch.Tensor:
    """Return the view's pose [4, 4] float64 in coordinates of the dataset."""
    return scene.frame.dataset_pose(view.viewmat) if scene.frame.moves else view.viewmat


def points_of(scene: Scene) -> np.ndarray:
    """Return the points [M, 3] in coordinates of the dataset."""
    points = scene.points.numpy()
    return points.astype(np.float64) * scene.frame.unit + scene.frame.centre if scene.frame.moves else points


def load_packed(path: Path, cloud: tuple[np.ndarray, np.ndarray] | None) -> Scene:
    """Read a file of `save_packed`; `cloud` (points, colours) replaces its points."""
    content = read_archive(path)
    if int(content["version"]) != VERSION:
        raise InputError(f"Packed scene {path} has version {content['version']}, expected {VERSION}; pack it again.")
    names, sizes = content["view_names"], content["image_sizes"]
    n, n_train = len(names), int(content["n_train"])
    lengths = {len(content[key]) for key in ("view_names", "Ks", "viewmats", "image_sizes")}
    data = content["image_bytes"].tobytes()
    whole = (sizes >= 0).all() and (sizes <= len(data)).all() and sum(sizes.tolist()) == len(data)
    if lengths != {n} or not whole or not 0 <= n_train <= n or len(content["points"]) != len(content["points_rgb"]):
        raise InputError(f"Packed scene {path} is damaged: the lengths of its arrays disagree; pack it again.")
    views, start = [], 0
    for i, size in enumerate(sizes.tolist()):
        label = f"{names[i]} in {path}"
        pixels, alpha = read_image(io.BytesIO(data[start : start + size]), label)
        start += size
        K = torch.from_numpy(content["Ks"][i].astype(np.float64))
        viewmat = torch.from_numpy(content["viewmats"][i].astype(np.float64))
        views.append(View(str(names[i]), pixels, K, viewmat, None if alpha is None else alpha >= 128))
    background = tuple(float(channel) for channel in content["background"])
    if not all(0.0 <= channel <= 1.0 for channel in background):
        raise InputError(f"Packed scene {path} has background {background}, outside 0..1; pack it again.")
    points, colours = cloud or (content["points"], content["points_rgb"])
    return assemble_scene(path, str(content["name"]), views[:n_train], views[n_train:], points, colours, background)  # type: ignore[arg-type]


def read_archive(path: Path) -> dict[str, Any]:
    """Return the arrays of the archive. Sizes, types and shapes are checked before memory is allocated."""
    try:
        with zipfile.ZipFile(path) as archive:
            for name, shape in SHAPES.items():
                check_header(archive, name, shape)
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in SHAPES}
    except Exception as error:  # zipfile, zlib and numpy raise many kinds of errors on damaged files
        raise InputError(f"Packed scene {path} is damaged or not one ({reason(error)}); pack it again.") from error


def check_header(archive: zipfile.ZipFile, name: str, expected: tuple[int | None, ...]) -> None:
    """Raise ValueError unless an array has the expected shape and type, and a size that the archive can hold."""
    member = archive.getinfo(f"{name}.npy")
    if member.file_size > max(BOMB, 20 * member.compress_size):
        raise ValueError(f"{name} claims {member.file_size:,} bytes in {member.compress_size:,}")
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
        start = stream.tell()
    if len(shape) != len(expected) or any(n is not None and m != n for m, n in zip(shape, expected, strict=True)):
        raise ValueError(f"{name} has shape {shape}")
    if dtype.kind not in KINDS.get(name, "iu"):
        raise ValueError(f"{name} has values of type {dtype}")
    if math.prod(shape) * dtype.itemsize != member.file_size - start:
        raise ValueError(f"{name} of shape {shape} does not fill its {member.file_size:,} bytes")


def encode_png(view: View) -> bytes:
    """Return the photograph as PNG bytes, with the mask as its alpha channel."""
    stream = io.BytesIO()
    pixels = view.image.numpy()
    if view.mask is not None:
        pixels = np.concatenate([pixels, view.mask.byte().numpy()[..., None] * 255], axis=2)
    Image.fromarray(pixels).save(stream, format="PNG")
    return stream.getvalue()
