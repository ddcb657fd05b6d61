"""`skipgs-plug sfm PHOTOS SCENE`: turn photographs or a video into a scene for `train`."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tqdm.auto import tqdm

from skipgs_plug.commands.options.sfm import Args
from skipgs_plug.install import next_command
from skipgs_plug.photos import global_mapping
from skipgs_plug.photos.choices import Mapping
from skipgs_plug.photos.gather import check_source, gather
from skipgs_plug.photos.origin import origin_of
from skipgs_plug.photos.reconstruct import Reconstruction
from skipgs_plug.photos.scene_folder import check_target, write_scene
from skipgs_plug.photos.unplaced import explain_unplaced
from skipgs_plug.trainer.errors import InputError

NAMES_SHOWN = 6  # photographs listed per reason, at most, so that the list stays readable


def run(args: Args) -> int:
    """Reconstruct, and print how many photographs were placed; see `Args`."""
    scene = reconstruct(args)
    train = next_command("train", scene, "--out", f"runs/{scene.resolve().name}")
    print(f"Scene: {scene}. Next: {train}")
    return 0


def reconstruct(args: Args) -> Path:
    """Write the scene completely or not at all, print how many photographs were placed, and return its folder.

    Raises:
        InputError: The photographs cannot be read or placed, or the folder is not empty.
    """
    if args.frames < 3:
        raise InputError(f"--frames {args.frames} is too few to reconstruct from; give at least 3, better 100.")
    scene = args.scene.expanduser()
    photos = args.photos.expanduser()
    check_source(photos)  # before anything is printed or written
    check_target(scene, photos)
    scene.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{scene.name}.", dir=scene.parent))

    def bar(title: str, total: int | None = None, **options: Any) -> tqdm:
        # Where the output is not a terminal, a bar ends with a line break before the next line is printed.
        leave = not sys.stderr.isatty()
        return tqdm(total=total, desc=title, disable=args.no_progress, unit="", leave=leave, **options)

    try:
        with bar("Reading photographs") as shown:
            origin = origin_of(photos)
            gathered = gather(photos, work / "photos", args.frames, shown.update)
        count = len(gathered.names)
        reconstruction = Reconstruction(gathered, work)
        with bar("Finding features", count) as shown:
            reconstruction.extract(shown.update)
        with bar("Matching pairs") as shown:
            matching = reconstruction.match(args.matching, shown.update)
        models, mapping = place(reconstruction, args.mapping, count, bar)
        unplaced = explain_unplaced(gathered, models, reconstruction.links())
        error = models[0].compute_mean_reprojection_error()
        points = models[0].num_points3D()
        with bar("Writing the scene", count - len(unplaced)) as shown:
            written = write_scene(reconstruction.undistort(models[0]), scene, origin, shown.update)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    print(
        f"{written} of {count} photographs placed ({matching} matching, {mapping} mapping), {points:,} points, "
        f"mean reprojection error {error:.2f} px."
    )
    print_unplaced(unplaced, matching)
    if gathered.masks is not None:
        print("Transparent pixels of the photographs are left out of training; masks/ shows them.")
    return scene


def place(
    reconstruction: Reconstruction, mapping: Mapping, count: int, bar: Callable[..., tqdm]
) -> tuple[list[Any], Mapping]:
    """Return the models, largest first, and the mapping that made them.

    Raises:
        InputError: No photograph could be placed.
    """
    models, taken = [], reconstruction.resolve(mapping)
    if taken == "global":
        # A stage takes seconds or minutes, so no remaining time is shown. The clock shows that the work continues.
        honest = {"miniters": 0, "bar_format": "{desc}: {n_fmt} of {total_fmt} stages done, {elapsed}"}
        with bar("Placing photographs all at once", global_mapping.STAGES, **honest) as shown:
            models = reconstruction.map_globally(shown.update)
        if mapping == "auto" and not reconstruction.placed_enough(models):
            print(f"Global mapping placed {size(models)} of {count} photographs; placing them one after another now.")
            taken = "incremental"
    if taken == "incremental":
        with bar("Placing photographs", count) as shown:
            others = reconstruction.map_incrementally(shown.update)
        if size(others) > size(models):
            models = others
        elif models:
            taken = "global"
    if not models:
        raise InputError(
            f"None of the {count} photographs could be placed; take sharper ones that overlap by two thirds, and walk "
            "around the subject instead of turning on the spot."
        )
    return models, taken


def size(models: Sequence[Any]) -> int:
    """Return the number of photographs in the largest model."""
    return models[0].num_reg_images() if models else 0


def print_unplaced(reasons: dict[str, str], matching: str) -> None:
    """Print the photographs that were left out, by reason."""
    if not reasons:
        return
    by_reason = defaultdict(list)
    for name, reason in reasons.items():
        by_reason[reason].append(name)
    print("Not placed:")
    for reason, names in by_reason.items():
        more = f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
        print(f"  {', '.join(names[:NAMES_SHOWN])}{more}: {reason}")
    if matching == "sequential":
        print(
            "  Mostly neighbours in the order of names were compared; --matching exhaustive compares all pairs, slowly."
        )
