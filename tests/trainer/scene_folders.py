"""Writes a scene as the folders that users have: COLMAP text model, Blender transforms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from skipgs_plug.trainer import Scene


def write_colmap(scene: Scene, root: Path, sub: str = "sparse/0", model: str = "PINHOLE") -> Path:
    """Write images (in a subfolder of `images`) and a text model; returns `root`."""
    views = sorted(scene.train + scene.test, key=lambda view: view.name)
    (root / "images" / "cam").mkdir(parents=True)
    (root / sub).mkdir(parents=True)
    K = views[0].K
    parameters = f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}" + (" 0 0 0 0" if model == "OPENCV" else "")
    (root / sub / "cameras.txt").write_text(f"1 {model} {views[0].width} {views[0].height} {parameters}\n")
    lines = []
    for i, view in enumerate(views):
        Image.fromarray(view.image.numpy()).save(root / "images" / "cam" / view.name)
        x, y, z, w = Rotation.from_matrix(view.viewmat[:3, :3].double().numpy()).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *view.viewmat[:3, 3].tolist()))
        lines += [f"{i + 1} {pose} 1 cam/{view.name}", ""]
    (root / sub / "images.txt").write_text("\n".join(lines) + "\n")
    write_points(root / sub / "points3D.txt", scene.points.numpy(), scene.points_rgb.numpy())
    return root


def write_points(path: Path, points: np.ndarray, colours: np.ndarray) -> None:
    rows = (
        f"{i + 1} {x} {y} {z} {r} {g} {b} 0.5"
        for i, ((x, y, z), (r, g, b)) in enumerate(zip(points.tolist(), colours.tolist(), strict=True))
    )
    path.write_text("\n".join(rows) + "\n")


def write_blender(scene: Scene, root: Path) -> Path:
    """Write RGBA images, transparent in the left half, and both transforms files; returns `root`."""
    for split, views in (("train", scene.train), ("test", scene.test)):
        (root / split).mkdir(parents=True)
        frames = []
        for view in views:
            alpha = np.full((view.height, view.width, 1), 255, dtype=np.uint8)
            alpha[:, : view.width // 2] = 0
            rgba = np.concatenate([view.image.numpy(), alpha], axis=2)
            Image.fromarray(rgba).save(root / split / view.name)
            pose = np.linalg.inv(view.viewmat.double().numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
            name = view.name.removesuffix(".png")
            frames.append({"file_path": f"./{split}/{name}", "transform_matrix": pose.tolist()})
        angle = 2 * np.arctan(views[0].width / 2 / float(views[0].K[0, 0]))
        (root / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    return root
