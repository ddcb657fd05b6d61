"""Small valid scenes, images, PLY files, checkpoints and gate states, and functions that load them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from skipgs_plug import SkipGate
from skipgs_plug.scripts.checkpoints import SUFFIX, Checkpoints
from skipgs_plug.trainer import Scene, TrainConfig, Trainer, load_scene, save_packed
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.loaders.undistorted_cache import FOLDER as UNDISTORTED
from skipgs_plug.trainer.ply import read_ply, read_points, write_ply
from skipgs_plug.trainer.scene import check_view
from skipgs_plug.trainer.synthetic import make_scene

MODEL = ("cameras", "images", "points3D")


class Source:
    """Valid files, and the function that loads them."""

    def __init__(self, folder: Path, files: list[str], load: Callable[[], object]) -> None:
        self.folder, self.load = folder, load
        self.files = {name: (folder / name).read_bytes() for name in files}
        self.listing = self.list()

    def list(self) -> list[Path]:
        return sorted(self.folder.rglob("*"))


def write_sources(root: Path) -> dict[str, Source]:
    """Write one small valid example of each format."""
    scene = make_scene(n_views=4, width=20, height=16, n_points=24, test_every=0)
    text = write_colmap(scene, root / "text")
    binary = write_colmap(scene, root / "binary")
    model = binary / "sparse/0"
    import_pycolmap().Reconstruction(str(model)).write_binary(str(model))
    for path in model.glob("*.txt"):
        path.unlink()
    return {
        "text": Source(
            text,
            [f"sparse/0/{name}.txt" for name in MODEL] + ["images/view_001.png", "masks/view_002.png"],
            lambda: load(text),
        ),
        "binary": Source(binary, [f"sparse/0/{path.name}" for path in model.iterdir()], lambda: load(binary)),
        "blender": write_blender(scene, root / "blender"),
        "nerfstudio": write_nerfstudio(scene, root / "nerfstudio"),
        "packed": write_packed(scene, root / "packed"),
        "images": write_images(root / "images"),
        "ply": write_plys(scene, root / "ply"),
        "states": write_states(scene, root / "states"),
    }


def load(path: Path) -> None:
    """Load a scene without a cache, and check the properties that the trainer relies on."""
    try:
        scene = load_scene(path, test_every=0, init_num_pts=50)
    finally:
        shutil.rmtree(path / UNDISTORTED, ignore_errors=True)
    assert scene.train and len(scene.points) >= 4 and scene.points.isfinite().all()
    assert 0 < scene.scene_scale < float("inf") and len(scene.points) == len(scene.points_rgb)
    for view in scene.train + scene.test:
        check_view(view, path)
        assert view.image.dtype == torch.uint8 and view.image.shape == (view.height, view.width, 3)
        assert view.mask is None or view.mask.shape == (view.height, view.width)
        assert view.K.dtype == view.viewmat.dtype == torch.float64


def write_colmap(scene: Scene, root: Path) -> Path:
    """Write a text model with a pinhole and a distorted camera, points that two images observe, and a mask."""
    from PIL import Image
    from scipy.spatial.transform import Rotation

    model = root / "sparse/0"
    for folder in (model, root / "images", root / "masks"):
        folder.mkdir(parents=True)
    K = scene.train[0].K
    intrinsics = f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}"
    (model / "cameras.txt").write_text(f"1 PINHOLE 20 16 {intrinsics}\n2 OPENCV 20 16 {intrinsics} 0.02 0 0 0\n")
    lines = []
    for i, view in enumerate(scene.train):
        Image.fromarray(view.image.numpy()).save(root / "images" / view.name)
        x, y, z, w = Rotation.from_matrix(view.viewmat[:3, :3].double().numpy()).as_quat()
        pose = " ".join(repr(float(v)) for v in (w, x, y, z, *view.viewmat[:3, 3].tolist()))
        observed = " ".join(f"{k % 20}.5 {k % 16}.5 {k + 1}" for k in range(len(scene.points)) if i < 2)
        lines += [f"{i + 1} {pose} {2 if i == 3 else 1} {view.name}", observed]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    rows = zip(scene.points.tolist(), scene.points_rgb.tolist(), strict=True)
    points = (f"{k + 1} {x} {y} {z} {r} {g} {b} 0.5 1 {k} 2 {k}" for k, ((x, y, z), (r, g, b)) in enumerate(rows))
    (model / "points3D.txt").write_text("\n".join(points) + "\n")
    Image.fromarray(np.pad(np.full((12, 14), 255, dtype=np.uint8), ((2, 2), (3, 3)))).save(root / "masks/view_002.png")
    return root


def write_blender(scene: Scene, root: Path) -> Source:
    content = {"camera_angle_x": 0.9, "frames": write_frames(scene, root)}
    (root / "transforms_train.json").write_text(json.dumps(content))
    return Source(root, ["transforms_train.json", "view_001.png"], lambda: load(root))


def write_nerfstudio(scene: Scene, root: Path) -> Source:
    K = scene.train[0].K.tolist()
    lens = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2], "k1": 0.02, "k2": 0, "p1": 0.001, "p2": 0}
    frames = write_frames(scene, root)
    frames[0]["mask_path"] = scene.train[1].name
    names = [view.name for view in scene.train]
    content = {"w": 20, "h": 16, "camera_model": "OPENCV", **lens, "ply_file_path": "sparse_pc.ply", "frames": frames}
    content |= {"train_filenames": names[:3], "val_filenames": names[3:]}
    (root / "transforms.json").write_text(json.dumps(content))
    write_cloud(scene, root / "sparse_pc.ply")
    return Source(root, ["transforms.json", "sparse_pc.ply", "view_001.png"], lambda: load(root))


def write_frames(scene: Scene, root: Path) -> list[dict[str, object]]:
    """Write RGBA images, and return the entry of each for a transforms file."""
    from PIL import Image

    root.mkdir()
    frames: list[dict[str, object]] = []
    for view in scene.train:
        Image.fromarray(view.image.numpy()).convert("RGBA").save(root / view.name)
        pose = np.linalg.inv(view.viewmat.double().numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": view.name, "transform_matrix": pose.tolist()})
    return frames


def write_cloud(scene: Scene, path: Path) -> None:
    from plyfile import PlyData, PlyElement

    kinds = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = [(*p, *c) for p, c in zip(scene.points.tolist(), scene.points_rgb.tolist(), strict=True)]
    PlyData([PlyElement.describe(np.array(rows, dtype=kinds), "vertex")]).write(str(path))


def write_packed(scene: Scene, root: Path) -> Source:
    root.mkdir()
    save_packed(scene, root / "scene.npz")
    return Source(root, ["scene.npz"], lambda: load(root / "scene.npz"))


def write_images(root: Path) -> Source:
    """Write one picture of each format. A mutated one must decode to a picture or be refused."""
    from PIL import Image

    root.mkdir()
    ramp = np.linspace(0, 65535, 20 * 30).reshape(20, 30).astype(np.uint16)
    grey = (ramp >> 8).astype(np.uint8)
    rgb = Image.fromarray(np.stack([grey, grey[::-1], 255 - grey], axis=2))
    Image.fromarray(ramp).save(root / "picture.tif", compression="tiff_lzw")
    rgb.convert("RGBA").save(root / "picture.png")
    for suffix in ("jpg", "webp", "gif", "bmp"):
        rgb.save(root / f"picture.{suffix}")
    files = [path.name for path in root.iterdir()]

    def load_images() -> None:
        for name in files:
            pixels, alpha = read_image(root / name, root / name)
            assert pixels.dtype == torch.uint8 and pixels.ndim == 3 and pixels.shape[2] == 3
            assert alpha is None or alpha.shape == pixels.shape[:2]

    return Source(root, files, load_images)


def write_plys(scene: Scene, root: Path) -> Source:
    """Write a model as binary and as text, and a point cloud."""
    from plyfile import PlyData

    root.mkdir()
    n = len(scene.points)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}
    generator = torch.Generator().manual_seed(0)
    write_ply({k: torch.randn(n, *shape, generator=generator) for k, shape in shapes.items()}, root / "model.ply")
    PlyData(PlyData.read(str(root / "model.ply")).elements, text=True).write(str(root / "text.ply"))
    write_cloud(scene, root / "points.ply")

    def load_plys() -> None:
        for name in ("model.ply", "text.ply"):
            splats = read_ply(root / name)
            assert all(t.isfinite().all() and len(t) == len(splats["means"]) for t in splats.values())
        points, colours = read_points(root / "points.ply")
        assert np.isfinite(points).all() and points.shape == colours.shape

    return Source(root, ["model.ply", "text.ply", "points.ply"], load_plys)


def write_states(scene: Scene, root: Path) -> Source:
    """Write a checkpoint of the trainer, and the state of a gate beside a script's checkpoint."""
    root.mkdir()
    trainer = Trainer(TrainConfig(max_steps=10), scene)
    trainer.save_checkpoint(root / "ckpt.pt")
    gate = SkipGate(start_iter=2, warmup=1)
    for step in range(12):
        gate.backward(torch.tensor(1.0 / (step + 1), requires_grad=True), view=f"{step % 3}.png", step=step)
    state = root / f"chkpnt.pth{SUFFIX}"
    state.write_text(json.dumps({"adapter": "inria", "script": "train.py", "gate": gate.state_dict()}))

    def load_states() -> None:
        trainer.load_checkpoint(root / "ckpt.pt")
        assert all(parameter.isfinite().all() for parameter in trainer.splats.values())
        content = Checkpoints("inria", "train.py", str(state)).state_for(12)
        resumed = SkipGate(start_iter=2, warmup=1)
        resumed.load_state_dict(content or {})
        resumed.backward(torch.tensor(0.5, requires_grad=True), view="0.png", step=12)
        assert resumed.report()["iterations"] >= 1

    return Source(root, ["ckpt.pt", state.name], load_states)
