"""What a scene was made of, written beside it, so that it is not taken for a scene of other photographs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

from skipgs_plug.photos.gather import photographs
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.files import write_json

FILE = "made_of.json"  # in the folder of the scene


class Origin(NamedTuple):
    """A video or a folder of photographs as it is at one time."""

    source: str  # absolute path without links
    sizes: dict[str, int]  # bytes of each photograph by its path in the folder, or of the video by its name


def origin_of(source: Path) -> Origin:
    """Return the present state of a video or a folder of photographs."""
    source = source.resolve()
    if source.is_file():
        return Origin(str(source), {source.name: source.stat().st_size})
    # `gather` refuses links to files that do not exist, with a sentence of its own.
    sizes = {path: path.stat().st_size if path.exists() else 0 for path in sorted(photographs(source))}
    return Origin(str(source), {path.relative_to(source).as_posix(): size for path, size in sizes.items()})


def write_origin(origin: Origin, scene: Path) -> None:
    """Write what a scene is made of into its folder."""
    write_json(scene / FILE, origin._asdict())


def read_origin(scene: Path) -> Origin | None:
    """Return what a scene was made of; None if its folder does not say so."""
    try:
        content = json.loads((scene / FILE).read_text(encoding="utf-8"))
        return Origin(str(content["source"]), dict(content["sizes"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def check_origin(scene: Path, source: Path) -> None:
    """Raise an error if a scene says that it was made of other photographs than those of `source`.

    Photographs with the same names and sizes are the same ones, also where they have been moved.

    Raises:
        InputError: It was made of another source, or the source has changed since.
    """
    made, now = read_origin(scene), origin_of(source)
    if made is None or made.sizes == now.sizes:
        return
    if made.source != now.source:
        what = f"{scene} was made of {made.source}, not of {source}"
    else:
        differing = len({name for name, _ in made.sizes.items() ^ now.sizes.items()})
        what = f"{source} has changed since {scene} was made of it (files that differ: {differing})"
    raise InputError(f"{what}; give another --out, or delete {scene} to make it anew.")


def described(scene: Path) -> str:
    """Return a sentence for the user that the scene of an earlier run is used again."""
    made = read_origin(scene)
    origin = "which does not say what it was made of" if made is None else f"made of {made.source}"
    return f"{scene} is used again, {origin}."
