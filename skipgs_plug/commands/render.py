"""`skipgs-plug render MODEL OUT`: a film or pictures of a trained model."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from torch import Tensor
from tqdm.auto import tqdm

from skipgs_plug.commands.options.render import Args
from skipgs_plug.trainer.backend import resolve_backend
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.scene import View
from skipgs_plug.view.draw import Painter, colour_depth, depth_range, to_bytes
from skipgs_plug.view.film import write_film, write_pictures
from skipgs_plug.view.model import open_model
from skipgs_plug.view.path import camera_path

FASTEST = 1000  # frames per second: encoders refuse numbers that are much larger
RANGE_FRAMES = 8  # frames that set the depth range; with all of them, the whole path would be rendered twice


def run(args: Args) -> int:
    """Render and write; see `Args`."""
    for name in ("frames", "fps"):
        if getattr(args, name) < 1:
            raise InputError(f"--{name} {getattr(args, name)} is too small; give at least 1.")
    if args.fps > FASTEST:
        raise InputError(f"--fps {args.fps} is too large; give at most {FASTEST:,}.")
    out = args.out.expanduser()
    if out.suffix.lower() not in ("", ".mp4"):
        raise InputError(f"{out} is neither a film (.mp4) nor a folder; give one of the two.")
    backend = resolve_backend(args.backend)  # refused before the scene is read, which can take minutes
    model = open_model(args.model, args.scene, args.data_factor)
    if model.scene is None:
        raise InputError(f"{args.model} names no cameras to render from; add --scene with the scene it shows.")
    held_out = sorted(model.scene.test, key=lambda view: view.name)
    train = sorted(model.scene.train, key=lambda view: view.name)
    if args.cameras == "held-out" and not held_out:
        raise InputError(f"Scene {model.scene.name} holds out no view; use --cameras path.")
    splats = model.load(model.snapshots[-1])
    painter = Painter.of(model, backend)

    if args.cameras == "path":
        lens = train[0]
        cameras = [(pose, lens) for pose in camera_path(train, args.frames)]
        names = [f"frame_{i:04d}" for i in range(args.frames)]
    else:
        cameras = [(view.viewmat, view) for view in held_out]
        names = [Path(view.name).with_suffix("").as_posix() for view in held_out]

    def draw(camera: tuple[Tensor, View]) -> tuple[Tensor, Tensor]:
        pose, lens = camera
        return painter.draw(splats, pose, lens.K, lens.width, lens.height)

    limits = (0.0, 1.0)
    if args.show != "colour":
        limits = depth_range([draw(camera)[1] for camera in cameras[:: max(1, len(cameras) // RANGE_FRAMES)]])

    def frames() -> Iterator[np.ndarray]:
        for camera in tqdm(cameras, desc="Rendering", disable=args.no_progress):
            image, depth = draw(camera)
            parts = {"colour": to_bytes(image), "depth": colour_depth(depth, limits)}
            yield np.concatenate(list(parts.values()), axis=1) if args.show == "both" else parts[args.show]

    if out.suffix.lower() == ".mp4":
        if len({(lens.width, lens.height) for _, lens in cameras}) > 1:
            raise InputError("The held-out views differ in size, so they cannot become a film; give a folder as OUT.")
        write_film(out, frames(), args.fps)
    else:
        write_pictures(out, frames(), names)
    near, far = (limit * model.scene.frame.unit for limit in limits)
    depths = "" if args.show == "colour" else f", depth from {near:.3g} to {far:.3g} scene units"
    print(f"{len(cameras)} frames, {len(splats['means']):,} Gaussians{depths}: {out}")
    return 0
