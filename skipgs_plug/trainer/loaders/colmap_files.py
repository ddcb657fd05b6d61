"""Check lengths in COLMAP's binary files: its reader trusts counts, whatever the size of the file."""

from __future__ import annotations

import itertools
import mmap
import os
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from skipgs_plug.trainer.errors import InputError, reason
from skipgs_plug.trainer.lfs import HINT, is_pointer

# Bytes of the records that COLMAP's files repeat.
POINT_2D = 24  # x and y, float64; id of the 3D point, uint64
TRACK_ELEMENT = 8  # id of the image and index of the 2D point, uint32
POSE = 56  # quaternion and translation, float64


def check_lengths(model: Path, camera_models: dict[int, int]) -> None:
    """Check for every binary file of a model that its counts fill it exactly.

    Args:
        model: Folder with cameras.bin, images.bin, points3D.bin and, in newer versions, rigs.bin and frames.bin.
        camera_models: Number of parameters by id of the camera model.

    Raises:
        InputError: A file is shorter or longer than its counts tell, or has an unknown camera model.
    """
    for name, walk in WALKS.items():
        path = model / name
        if not path.is_file():
            continue
        if is_pointer(path):
            raise InputError(f"{path} cannot be read: {HINT}.")
        try:
            with open(path, "rb") as stream:
                size = os.fstat(stream.fileno()).st_size
                data: Any = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
        except OSError as error:
            raise InputError(f"{path} cannot be read ({reason(error)}).") from error
        at = 0
        try:
            for at in walk(data, camera_models):
                if at > size:
                    break
        except struct.error:  # a count or a name would lie behind the end
            at = size + 1
        except KeyError as error:
            raise InputError(f"{path} has a camera of unknown model {error}; export the model again.") from error
        if at != size:
            what = "ends early" if at > size else f"has {size - at:,} bytes too many"
            raise InputError(f"{path} {what}: its counts do not fit its {size:,} bytes; export the model again.")


def leave_out_points(model: Path, target: Path) -> None:
    """Write a binary model into `target` without points: cameras, and images without observations of points."""
    shutil.copyfile(model / "cameras.bin", target / "cameras.bin")
    (target / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    data = (model / "images.bin").read_bytes()
    kept, start = [data[:8]], 8
    for end in itertools.islice(walk_images(data, None), 1, None):
        name = data.index(b"\0", start + 4 + POSE + 4) + 1
        kept += [data[start:name], struct.pack("<Q", 0)]
        start = end
    (target / "images.bin").write_bytes(b"".join(kept))


def walk_cameras(data: Any, camera_models: dict[int, int]) -> Iterator[int]:
    """Yield the position after the count and after every record."""
    at = 8
    yield at
    for _ in range(unpack("<Q", data, 0)):
        at += 24 + 8 * camera_models[unpack("<i", data, at + 4)]
        yield at


def walk_images(data: Any, _: Any) -> Iterator[int]:
    at = 8
    yield at
    for _ in range(unpack("<Q", data, 0)):
        end = data.find(b"\0", at + 4 + POSE + 4)
        at = end + 1 if end >= 0 else len(data)
        at += 8 + POINT_2D * unpack("<Q", data, at)
        yield at


def walk_points(data: Any, _: Any) -> Iterator[int]:
    at = 8
    yield at
    for _ in range(unpack("<Q", data, 0)):
        at += 51 + TRACK_ELEMENT * unpack("<Q", data, at + 43)
        yield at


def walk_rigs(data: Any, _: Any) -> Iterator[int]:
    at = 8
    yield at
    for _ in range(unpack("<Q", data, 0)):
        sensors = unpack("<I", data, at + 4)
        at += 8 + (8 if sensors else 0)  # the reference sensor has no pose
        for _ in range(sensors - 1):
            at += 9 + (POSE if data[at + 8 : at + 9] != b"\0" else 0)
            yield at
        yield at


def walk_frames(data: Any, _: Any) -> Iterator[int]:
    at = 8
    yield at
    for _ in range(unpack("<Q", data, 0)):
        at += 12 + POSE + 16 * unpack("<I", data, at + 8 + POSE)
        yield at


def unpack(kind: str, data: Any, at: int) -> int:
    return struct.unpack_from(kind, data, at)[0]


WALKS = {
    "cameras.bin": walk_cameras,
    "images.bin": walk_images,
    "points3D.bin": walk_points,
    "rigs.bin": walk_rigs,
    "frames.bin": walk_frames,
}
