"""COLMAP's text models, including variants that other programs write.

pycolmap ends a name at its first space. It also reads every second line of images.txt as observations, even if a
program left these lines out. This module reads both correctly, and passes the model to pycolmap without observations,
which the package does not use.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from skipgs_plug.trainer.errors import InputError, reason

IMAGE_FIELDS = 9  # id, quaternion, translation, camera; then the name


def simplify(model: Path, target: Path, camera_models: Mapping[str, int]) -> tuple[dict[int, str], int]:
    """Write a text model into `target` without observations, and with numbers as names of images.

    Args:
        model: Folder of the model.
        target: Folder to write.
        camera_models: Number of parameters by name of the camera model.

    Returns:
        The names of the images, by their ids, and the number of points.

    Raises:
        InputError: A file cannot be read, or one of its lines has the wrong form.
    """
    cameras = content_lines(model / "cameras.txt")
    for line in cameras:
        check_parameters(line.split(), camera_models, model / "cameras.txt")
    (target / "cameras.txt").write_text("\n".join(cameras) + "\n", encoding="utf-8")
    known = {line.split()[0] for line in cameras if line.strip()}
    names, lines = {}, []
    for number, fields in image_records(model / "images.txt", known):
        if number in names:
            raise InputError(f"{model / 'images.txt'} gives the id {number} to two images; export the model again.")
        names[number] = fields[IMAGE_FIELDS]
        lines += [" ".join([*fields[:IMAGE_FIELDS], str(number)]), ""]
    (target / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    listed = content_lines(model / "points3D.txt") if (model / "points3D.txt").is_file() else []
    points = [" ".join(point_of(line.split())) for line in listed if line.strip()]
    (target / "points3D.txt").write_text("\n".join(points) + "\n", encoding="utf-8")
    return names, len(points)


def point_of(fields: list[str]) -> list[str]:
    """Return id, position, colour and error of a point, with colours such as 254.0 as whole numbers."""
    try:
        colour = [str(round(float(value))) for value in fields[4:7]]
    except (ValueError, OverflowError):
        colour = fields[4:7]  # pycolmap refuses the line
    return [*fields[:4], *colour, *fields[7:8]]


def check_parameters(fields: list[str], camera_models: Mapping[str, int], path: Path) -> None:
    """Raise InputError for a camera with a wrong number of parameters: pycolmap's error does not name it."""
    if len(fields) < 4 or fields[1] not in camera_models:
        return
    expected, given = camera_models[fields[1]], len(fields) - 4
    if given != expected:
        raise InputError(
            f"{path}: camera {fields[0]} has {given} parameters, but its model {fields[1]} has {expected}; export the "
            "reconstruction again."
        )


def image_records(path: Path, cameras: set[str]) -> list[tuple[int, list[str]]]:
    """Return id and fields of each image. The name is the last field and may hold spaces.

    Args:
        path: The file images.txt.
        cameras: Ids of the model's cameras, which distinguish an image from observations.
    """
    records: list[tuple[int, list[str]]] = []
    observations = False  # whether the line may hold observations of the image before it
    for line in content_lines(path):
        fields = line.strip().split(maxsplit=IMAGE_FIELDS)
        if observations and not is_image(fields, line.split(), cameras):
            observations = False
            continue
        if not fields:
            continue
        if len(fields) <= IMAGE_FIELDS or not fields[0].isdigit():
            raise InputError(f"{path}: {line[:80]!r} is not the line of an image; export the model again.")
        records.append((int(fields[0]), fields))
        observations = True
    return records


def is_image(fields: list[str], words: list[str], cameras: set[str]) -> bool:
    """Whether a line that may hold observations (x, y, id; x, y, id; ...) describes an image."""
    if len(fields) <= IMAGE_FIELDS or not fields[0].isdigit() or fields[8] not in cameras:
        return False
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return True  # a name
    return len(numbers) % 3 != 0 or math.isclose(math.hypot(*numbers[1:5]), 1.0, abs_tol=1e-3)


def content_lines(path: Path) -> list[str]:
    """Return the lines of a text file without comments, for any kind of line break."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({reason(error)}).") from error
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    text = data.decode(encoding, errors="surrogateescape" if encoding != "utf-16" else "replace")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return [line for line in lines if not line.lstrip().startswith("#")]
