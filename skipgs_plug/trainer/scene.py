"""Scene and View: images with camera poses, and a point cloud, independent of the file format."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.files import printable
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.frame import Frame

BLACK = (0.0, 0.0, 0.0)
WHITE = (1.0, 1.0, 1.0)
MIN_POINTS = 4  # the scale of an initial Gaussian is the mean distance to its three nearest neighbours
MIN_SIDE = 11  # pixels: the side of SSIM's window
SCENE_SCALE = 1.1  # scale of every scene: 3DGS's factor times the cameras' extent, which is 1 in local coordinates
MAX_COORDINATE = 1e15  # units of the scene: squares of distances stay below the largest float32, 3e38


@dataclass
class View:
    """One posed photograph.

    `name` is the image path relative to the scene. It is unique, and a gate uses it as the key of the view. The camera
    looks along +z, with x right and y down; pixel centres lie at +0.5. Camera matrices are float64, so that a scene has
    the same cameras in every file format. Renderers take them as float32.
    """

    name: str
    image: Tensor  # [H, W, 3] uint8
    K: Tensor  # [3, 3] float64, pixels of `image`
    viewmat: Tensor  # [4, 4] float64, world to camera
    mask: Tensor | None = None  # [H, W] bool, False where a pixel does not count; None: all count

    @property
    def width(self) -> int:
        """Image width in pixels."""
        return self.image.shape[1]

    @property
    def height(self) -> int:
        """Image height in pixels."""
        return self.image.shape[0]

    @property
    def blank(self) -> bool:
        """Whether the mask leaves no pixel to train on."""
        return self.mask is not None and not bool(self.mask.any())


@dataclass
class Scene:
    """Training views, held-out views and the points that training starts from.

    Cameras and points are in local coordinates, around the origin and in a unit of their own: see `frame`. Files are
    written in coordinates of the dataset, so an exported PLY lies where its cameras are. Every length in the recipe is
    multiplied by `scene_scale`.

    Examples:
        >>> from skipgs_plug.trainer.synthetic import make_scene
        >>> scene = make_scene(n_views=10, width=32, height=24, n_points=160)
        >>> scene.points.shape, scene.test[0].name
        (torch.Size([160, 3]), 'view_000.png')
    """

    name: str
    train: list[View]
    test: list[View]
    points: Tensor  # [M, 3] float32
    points_rgb: Tensor  # [M, 3] uint8
    scene_scale: float  # 1.1 x the extent that `frame` makes 1; 3DGS's name and factor for it
    background: tuple[float, float, float] = BLACK  # colour in [0, 1] behind the scene
    gaussians: dict[str, Tensor] | None = None  # raw parameters to start from, in local coordinates; None: from points
    frame: Frame = field(default_factory=Frame)  # from local coordinates to those of the dataset


def split_views(views: list[View], test_every: int) -> tuple[list[View], list[View]]:
    """Sort by name, hold out index % test_every == 0, and return (train, test)."""
    views = sorted(views, key=lambda view: view.name)
    if test_every == 0:
        return views, []
    test = views[::test_every]
    return [view for i, view in enumerate(views) if i % test_every], test


def all_held_out(source: Path) -> InputError:
    """Return the error to raise when no view is left to train on."""
    return InputError(
        f"{source} leaves no training view: every view is held out. Give --test-every 0 (test_every=0) to train on all "
        "of them."
    )


def assemble_scene(
    source: Path,
    name: str,
    train: list[View],
    test: list[View],
    points: np.ndarray,
    points_rgb: np.ndarray,
    background: tuple[float, float, float] = BLACK,
) -> Scene:
    """Check views and points, and build the Scene. Errors name `source`."""
    if not train:
        raise all_held_out(source)
    names: set[str] = set()
    for view in train + test:
        if view.name in names:
            raise InputError(f"{source} names two views {view.name!r}; image paths must be unique.")
        names.add(view.name)
        check_view(view, source)
    check_points(points, source)
    for view in train + test:
        view.viewmat, view.K = view.viewmat.double(), view.K.double()
    frame = Frame.of(torch.stack([view.viewmat for view in train]).numpy(), np.asarray(points, np.float64))
    if frame.moves:
        for view in train + test:
            view.viewmat = frame.local_pose(view.viewmat)
        points = frame.to_local(points)
    return Scene(
        name=printable(name),
        train=train,
        test=test,
        points=torch.from_numpy(np.ascontiguousarray(points, dtype=np.float32)),
        points_rgb=torch.from_numpy(np.ascontiguousarray(points_rgb, dtype=np.uint8)),
        scene_scale=SCENE_SCALE,
        background=background,
        frame=frame,
    )


def check_view(view: View, source: Path) -> None:
    """Raise InputError for a view that cannot be trained on."""
    if not is_text(view.name):
        raise InputError(f"{source}: view name {view.name[:80]!r} holds control characters or is not UTF-8; rename it.")
    if not (torch.isfinite(view.viewmat).all() and torch.isfinite(view.K).all()):
        raise InputError(f"{source}: camera of {view.name!r} holds NaN or infinity; reconstruct it again.")
    if view.K[0, 0] <= 0 or view.K[1, 1] <= 0:
        raise InputError(f"{source}: camera of {view.name!r} has a focal length of 0 or less; reconstruct it again.")
    if abs(float(torch.linalg.det(view.viewmat[:3, :3].double()))) < 1e-6:
        raise InputError(f"{source}: the pose of {view.name!r} cannot be inverted; reconstruct it again.")
    if min(view.width, view.height) < MIN_SIDE:
        raise InputError(
            f"{source}: {view.name!r} is {view.width}x{view.height}, but SSIM needs {MIN_SIDE} pixels on each side; "
            "use larger images or a smaller data_factor."
        )
    if view.blank:
        raise InputError(f"{source}: the mask of {view.name!r} leaves no pixel; white pixels are kept.")


def check_points(points: np.ndarray, source: Path) -> None:
    """Raise InputError for a point cloud that training cannot start from."""
    if len(points) < MIN_POINTS:
        raise InputError(
            f"{source} has {len(points)} points, but at least {MIN_POINTS} are needed; get a larger cloud, or give "
            "one by --init-ply."
        )
    bad = int((~(np.abs(points) < MAX_COORDINATE).all(axis=1)).sum())
    if bad:
        raise InputError(f"{source} has {bad} points with NaN, infinite or huge coordinates; remove them.")


def is_text(name: str) -> bool:
    """Whether a name can be printed and written: it has no control characters and no surrogates."""
    return not any(ord(c) < 32 or 0xD800 <= ord(c) <= 0xDFFF for c in name)
