"""COLMAP folders: sparse/0 or sparse, images, images_{factor}, masks."""

from __future__ import annotations

import contextlib
import logging
import re
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from skipgs_plug.files import OUT_OF_SPACE, WriteError
from skipgs_plug.trainer.errors import InputError, MissingFileError, reason
from skipgs_plug.trainer.image_store import ImageStore
from skipgs_plug.trainer.loaders.colmap_files import check_lengths, leave_out_points
from skipgs_plug.trainer.loaders.colmap_text import content_lines, image_records, simplify
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.loaders.paths import find_images, relative_name, subfolder
from skipgs_plug.trainer.loaders.photograph import PINHOLE_MODELS, find_mask, load_photograph, lost_angle, model_name
from skipgs_plug.trainer.loaders.undistorted_cache import UndistortedCache
from skipgs_plug.trainer.loaders.unused_files import warn_of_missing_masks, warn_of_unlisted_images
from skipgs_plug.trainer.ply import read_points
from skipgs_plug.trainer.scene import Scene, View, assemble_scene, split_views

log = logging.getLogger(__name__)


STEMS = ("cameras", "images")
MODEL_FOLDERS = ("sparse", "colmap/sparse")  # the second one is written by nerfstudio
Cloud = tuple[np.ndarray, np.ndarray]


def load_colmap(path: Path, data_factor: int, test_every: int, images: ImageStore, cloud: Cloud | None) -> Scene:
    """Load a COLMAP reconstruction; see `load_scene`. `path` is the scene or one of its models.

    `cloud` (points, colours) replaces its points.
    """
    if is_model(path):
        model, path = path, scene_of(path)
    else:
        model = find_model(path)
    reconstruction, names = read_model(model)
    folder, factor = image_folder(path, data_factor)
    masks = subfolder(path, "masks")
    cache = UndistortedCache(path)
    listed = [reconstruction.images[number] for number in sorted(reconstruction.images)]
    called = [relative_name(folder, names.get(image.image_id) or image_name(image, model)) for image in listed]
    placed = [(image, name) for image, name in zip(listed, called, strict=True) if image.has_pose]
    unplaced = len(listed) - len(placed)
    paths = find_images(folder, [name for _, name in placed])
    found_masks = [find_mask(masks, name) if masks.is_dir() else None for _, name in placed]
    views, distorted = [], set()
    for (image, name), image_path, mask in images.reading(list(zip(placed, paths, found_masks, strict=True))):
        camera = reconstruction.cameras[image.camera_id]
        pose = pose_of(image, name, model)
        views.append(load_photograph(name, image_path, camera, pose, cache, factor, mask, images))
        if model_name(camera) not in PINHOLE_MODELS:
            distorted.add(model_name(camera) + lost_angle(camera, views[-1]))
    if not views:
        raise InputError(f"{model} registers no image; run COLMAP again with more overlap between photographs.")
    if distorted:
        log.warning(
            "%s: lens distortion (%s) is removed, and the result is cached.", path, ", ".join(sorted(distorted))
        )
    if unplaced:
        log.warning("%s: %d of %d images have no pose and are left out.", model, unplaced, unplaced + len(views))
    warn_of_unlisted_images(folder, [*paths, *(folder / name for name in called)], "images of the model")
    warn_of_missing_masks(masks, found_masks)
    return assemble(path, model, views, reconstruction, test_every, cloud)


def assemble(
    path: Path, model: Path, views: list[View], reconstruction: Any, test_every: int, cloud: Cloud | None
) -> Scene:
    train, test = split_views(views, test_every)
    if cloud is not None:
        return assemble_scene(model, path.resolve().name, train, test, *cloud)
    beside = cloud_beside(model)
    if beside is not None:
        return assemble_scene(model, path.resolve().name, train, test, *beside)
    points = [reconstruction.points3D[i] for i in sorted(reconstruction.points3D)]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    rgb = np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)
    return assemble_scene(model, path.resolve().name, train, test, xyz, rgb)


def cloud_beside(model: Path) -> Cloud | None:
    """Return points and colours of the points3D.ply that Inria's trainer writes, if the model has no other points."""
    path = model / "points3D.ply"
    others = (model / f"points3D{suffix}" for suffix in (".bin", ".txt"))
    if any(other.is_file() for other in others) or not path.is_file():
        return None
    return read_points(path)


def is_model(folder: Path) -> bool:
    """Whether a folder holds cameras and images (.bin or .txt). Points are optional."""
    return any(is_complete(folder, suffix) for suffix in (".bin", ".txt"))


def is_complete(folder: Path, suffix: str) -> bool:
    return all((folder / (stem + suffix)).is_file() for stem in STEMS)


def scene_of(model: Path) -> Path:
    """Return the scene of a model: the nearest folder above it with images, or the model's own folder."""
    parents = [model, *model.resolve().parents[:3]]
    return next((folder for folder in parents if subfolder(folder, "images").is_dir()), model)


def find_model(path: Path) -> Path:
    """Return the model of a scene: the first of sparse/0, sparse, sparse/1 and so on. Warn if another one is larger.

    Raises:
        MissingFileError: There is no model.
    """
    found: list[Path] = []
    for name in MODEL_FOLDERS:
        root = path / name
        numbered = sorted(root.glob("*"), key=lambda folder: [int(n) for n in re.findall(r"\d+", folder.name)] or [-1])
        found += [folder for folder in (root / "0", root, *numbered) if is_model(folder) and folder not in found]
        if found:
            break
    if not found:
        raise MissingFileError(
            f"Neither {path / 'sparse' / '0'} nor {path / 'sparse'} holds cameras and images "
            "(.bin or .txt); run COLMAP's mapper."
        )
    counts = [listed_images(folder) for folder in found]
    largest = counts.index(max(counts))
    if counts[largest] > counts[0]:
        log.warning(
            "%s has %d images, %s has %d; to take the larger model, give %s as SCENE.",
            *(found[0], counts[0], found[largest], counts[largest], found[largest]),
        )
    return found[0]


def listed_images(model: Path) -> int:
    """Return how many images a model lists; 0 if that is unknown."""
    return listed_in_binary(model) if (model / "images.bin").is_file() else listed_in_text(model)


def listed_in_binary(model: Path) -> int:
    try:
        with open(model / "images.bin", "rb") as stream:
            return int(struct.unpack("<Q", stream.read(8))[0])
    except (struct.error, OSError):
        return 0


def listed_in_text(model: Path) -> int:
    try:
        cameras = {line.split()[0] for line in content_lines(model / "cameras.txt") if line.strip()}
        return len(image_records(model / "images.txt", cameras))
    except InputError:
        return 0


def say_if_both(model: Path) -> None:
    """Warn if a text model beside the binary one, which is read, lists another number of images."""
    if not (is_complete(model, ".bin") and is_complete(model, ".txt")):
        return
    binary, text = listed_in_binary(model), listed_in_text(model)
    if binary != text:
        log.warning("%s: images.bin lists %d images and is read; images.txt lists %d.", model, binary, text)


def read_model(model: Path) -> tuple[Any, dict[int, str]]:
    """Read the reconstruction, and turn errors of pycolmap into one sentence.

    Returns:
        The reconstruction, and for a text model the correct names of its images by id.
    """
    pycolmap = import_pycolmap()
    models = camera_models(pycolmap)
    check_lengths(model, {number: count for number, (_, count) in models.items()})
    try:
        say_if_both(model)
        if is_complete(model, ".bin") and (model / "points3D.bin").is_file():
            return pycolmap.Reconstruction(str(model)), {}
        with temporary_copy(model) as folder:
            if is_complete(model, ".bin"):
                leave_out_points(model, folder)
                return pycolmap.Reconstruction(str(folder)), {}
            names, points = simplify(model, folder, dict(models.values()))
            reconstruction = pycolmap.Reconstruction(str(folder))
        for what, listed, read in (
            ("images", len(names), len(reconstruction.images)),
            ("points", points, len(reconstruction.points3D)),
        ):
            if listed != read:
                raise InputError(f"{model} lists {listed} {what}, but only {read} can be read; export it again.")
        return reconstruction, names
    except (InputError, WriteError):
        raise
    except Exception as error:  # pycolmap raises RuntimeError, ValueError or IndexError
        raise InputError(f"COLMAP model {model} cannot be read ({reason(error)}); export it again.") from error


@contextlib.contextmanager
def temporary_copy(model: Path) -> Iterator[Path]:
    """Yield a temporary folder for a copy of a model.

    Raises:
        WriteError: The copy cannot be written. Errors of reading the model pass.
    """
    try:
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder)
    except OSError as error:
        if error.errno not in OUT_OF_SPACE and error.filename is not None:
            raise
        raise WriteError(
            f"A temporary copy of {model} cannot be written ({error.strerror}); set TMPDIR to a folder with room."
        ) from error


def camera_models(pycolmap: Any) -> dict[int, tuple[str, int]]:
    """Return name and number of parameters of each camera model by its id in files."""
    create = getattr(pycolmap.Camera, "create_from_model_id", pycolmap.Camera.create)  # create: before pycolmap 4
    models = [model for model in pycolmap.CameraModelId.__members__.values() if int(model) >= 0]
    return {int(model): (model.name, len(create(1, model, 1.0, 2, 2).params)) for model in models}


def image_name(image: Any, model: Path) -> str:
    try:
        return image.name
    except UnicodeDecodeError as error:
        raise InputError(
            f"{model} names image {image.image_id} in a name that is not UTF-8; rename the file and map again."
        ) from error


def pose_of(image: Any, name: str, model: Path) -> np.ndarray:
    """Return world to camera [4, 4]."""
    pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
    viewmat = np.eye(4)
    viewmat[:3] = pose.matrix()
    length = np.linalg.norm(pose.rotation.quat)
    if not (np.isfinite(viewmat).all() and abs(length - 1) < 1e-3 and np.abs(viewmat).max() < 1e12):
        raise InputError(f"{model}: the pose of {name!r} is not valid (quaternion of length {length:g}); map it again.")
    return viewmat


def image_folder(path: Path, data_factor: int) -> tuple[Path, int]:
    """Return the folder to read, and the factor by which photographs must be reduced in memory."""
    full = subfolder(path, "images")
    if data_factor > 1:
        reduced = subfolder(path, f"images_{data_factor}")
        if reduced.is_dir():
            return reduced, 1
        if full.is_dir():
            log.warning("%s does not exist: resizing %s by %d in memory.", reduced, full, data_factor)
    if not full.is_dir():
        raise MissingFileError(f"Image folder {full} does not exist; put the photographs there.")
    return full, data_factor
