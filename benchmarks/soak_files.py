"""Mutated scene, image and PLY files: each is refused with a sentence or loads as something sound.

    from benchmarks.soak_files import run
    run(count=20_000, seed=7)

A case is a function of seed and number, so `run(count=1, seed=7, first=1234)` repeats one. Cases run in child
processes with bounded memory; a crash, a hang, a foreign exception, an unsound scene or a file that appeared is
reported with seed, number and what had been done to which file.
"""

from __future__ import annotations

import faulthandler
import json
import random
import resource
import struct
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from skipgs_plug.trainer import InputError, Scene, load_scene, save_packed
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.ply import read_ply, read_points, write_ply
from skipgs_plug.trainer.scene import check_view
from skipgs_plug.trainer.synthetic import make_scene

ROOT = Path(__file__).parents[1]
MEMORY = 1 << 30  # bytes of address space beyond what the libraries take
SECONDS = 20.0  # for one case, which takes milliseconds: then the child ends itself, wherever it is
BATCH = 500
NUMBERS = (0, 1, -1, 127, 255, 2**31 - 1, -(2**31), 2**32 - 1, 2**40, 2**62, -(2**63), 2**64 - 1)
REALS = (0.0, -1.0, 1e-300, 1e300, float("nan"), float("inf"), 1e20)
TOKENS = (
    "nan",
    "1e999",
    "-1",
    "0",
    "9" * 5000,
    "[" * 20_000,
    "../x",
    "/",
    "\\",
    "\0",
    "null",
    '""',
    "{}",
    " ",
    "\ud800",
)


def run(count: int, seed: int, first: int = 0, batch: int = BATCH) -> dict[str, int]:
    """Run cases `first` to `first + count - 1` and count their outcomes: `refused` and `loaded`.

    Raises:
        AssertionError: some case was neither; every one is listed.
    """
    outcomes: Counter[str] = Counter()
    failures: list[str] = []
    last = first + count
    while first < last:
        end = min(first + batch, last)
        done = run_batch(seed, first, end, outcomes, failures)
        if done < end:  # the child died in this case: go on behind it
            done += 1
        first = done
    if failures:
        raise AssertionError(f"{len(failures)} of {count} mutated files (seed {seed}):\n" + "\n".join(failures))
    return dict(outcomes)


def run_batch(seed: int, first: int, end: int, outcomes: Counter[str], failures: list[str]) -> int:
    """Run cases in one child process; returns the number of the case it did not survive, or `end`."""
    done = first
    process = subprocess.run(
        [sys.executable, "-c", child_command(seed, first, end)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        errors="replace",
    )
    lines = [line for line in process.stdout.splitlines() if line.startswith("{")]
    if not lines:
        raise RuntimeError(f"The unmutated files do not load:\n{process.stderr}")
    for line in lines[1:]:
        result = json.loads(line)
        done = result["case"] + 1
        outcomes[result["outcome"]] += 1
        if result["outcome"] == "failed":
            failures.append(f"case {result['case']}: {result['what']}: {result['why']}")
    if done < end:
        what = Case(seed, done).what
        failures.append(f"case {done}: {what}: ended with {process.returncode}: {process.stderr.strip()[-800:]}")
    return done


def child_command(seed: int, first: int, end: int) -> str:
    return f"from benchmarks.soak_files import child; child({seed}, {first}, {end})"


def child(seed: int, first: int, end: int) -> None:
    """Run cases in this process and print one line of JSON for each."""
    with tempfile.TemporaryDirectory() as name:
        sources = write_sources(Path(name))
        for source in sources.values():
            source.load()  # loads libraries and makes threads before memory is bounded
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        print("{}", flush=True)
        for number in range(first, end):
            case = Case(seed, number)
            faulthandler.dump_traceback_later(SECONDS, exit=True)
            print(json.dumps({"case": number, "what": case.what, **case.run(sources[case.source])}), flush=True)


class Source:
    """Files that load, and the function that loads them."""

    def __init__(self, folder: Path, files: list[str], load: Callable[[], object]) -> None:
        self.folder, self.load = folder, load
        self.files = {name: (folder / name).read_bytes() for name in files}
        self.listing = self.list()

    def list(self) -> list[Path]:
        return sorted(self.folder.rglob("*"))


class Case:
    """One mutation of one file, chosen by seed and number."""

    def __init__(self, seed: int, number: int) -> None:
        self.random = random.Random(f"{seed}:{number}")
        self.source, self.file = self.random.choice(TARGETS)
        mutations = TEXT if self.file.endswith((".txt", ".json")) and self.random.random() < 0.7 else BYTES
        self.mutations = [self.random.choice(mutations) for _ in range(self.random.choice((1, 1, 1, 2, 4)))]
        self.what = f"{self.source}/{self.file} by {', '.join(m.__name__ for m in self.mutations)}"

    def run(self, source: Source) -> dict[str, str]:
        """Mutate, load, and put the file back."""
        content = source.files[self.file]
        for mutate in self.mutations:
            content = mutate(content, self.random)
        path = source.folder / self.file
        path.write_bytes(content)
        outcome = {"outcome": "loaded"}
        try:
            source.load()
        except InputError as error:
            outcome = {"outcome": "refused"}
            if not str(error) or "\n" in str(error).strip() or len(str(error)) > 2000:
                outcome = {"outcome": "failed", "why": f"not one sentence: {str(error)[:500]!r}"}
        except BaseException:
            outcome = {"outcome": "failed", "why": traceback.format_exc()[-1500:]}
        path.write_bytes(source.files[self.file])
        if source.list() != source.listing:
            outcome = {"outcome": "failed", "why": f"left {sorted(set(source.list()) - set(source.listing))}"}
        return outcome


def truncate(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def flip_bits(content: bytes, rng: random.Random) -> bytes:
    out = bytearray(content)
    for _ in range(rng.choice((1, 2, 8, 64))):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def overwrite(content: bytes, rng: random.Random) -> bytes:
    """Put a number that counts, sizes or coordinates seldom have over some bytes; often near the start."""
    if rng.random() < 0.5:
        kind, value = rng.choice("BHIQ"), rng.choice(NUMBERS)
        size = struct.calcsize(kind)
        data = (value % (1 << 8 * size)).to_bytes(size, rng.choice(("little", "big")))
    else:
        data = struct.pack(rng.choice(("<d", "<f")), rng.choice([v for v in REALS if abs(v) < 1e38 or v != v]))
    at = rng.randrange(min(len(content), rng.choice((16, 200, 1 << 30))) + 1)
    return content[:at] + data + content[at + len(data) :]


def insert(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content) + 1)
    return content[:at] + rng.randbytes(rng.choice((1, 4, 100))) + content[at:]


def cut(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content) + 1)
    return content[:at] + content[at + rng.choice((1, 8, 100)) :]


def repeat(content: bytes, rng: random.Random) -> bytes:
    at, end = sorted(rng.randrange(len(content) + 1) for _ in range(2))
    return content[:end] + content[at:]


def replace_token(content: bytes, rng: random.Random) -> bytes:
    """Replace one number, word or string of a text."""
    text = content.decode("utf-8", "replace")
    words = text.replace(",", " , ").replace(":", " : ").split(" ")
    words[rng.randrange(len(words))] = rng.choice(TOKENS)
    return " ".join(words).encode("utf-8", "surrogatepass")


def drop_line(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    del lines[rng.randrange(len(lines))]
    return b"\n".join(lines)


BYTES = (truncate, flip_bits, overwrite, overwrite, insert, cut, repeat)
TEXT = (replace_token, replace_token, replace_token, drop_line)

COLMAP = ("cameras", "images", "points3D")
TARGETS = [  # (source, file); the binary model twice, for it is what others send
    *(("binary", f"sparse/0/{name}.bin") for name in COLMAP * 2),
    *(("binary", f"sparse/0/{name}.bin") for name in ("rigs", "frames")),
    *(("text", f"sparse/0/{name}.txt") for name in COLMAP),
    ("text", "images/view_001.png"),
    ("text", "masks/view_002.png"),
    ("blender", "transforms_train.json"),
    ("blender", "view_001.png"),
    ("nerfstudio", "transforms.json"),
    ("nerfstudio", "transforms.json"),
    ("nerfstudio", "sparse_pc.ply"),
    ("nerfstudio", "view_001.png"),
    ("packed", "scene.npz"),
    ("packed", "scene.npz"),
    *(("images", f"picture.{suffix}") for suffix in ("png", "jpg", "tif", "webp", "gif", "bmp")),
    *(("ply", f"{name}.ply") for name in ("model", "model", "text", "points")),
]


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
        "text": Source(text, [file for source, file in TARGETS if source == "text"], lambda: load(text)),
        "binary": Source(binary, [f"sparse/0/{path.name}" for path in model.iterdir()], lambda: load(binary)),
        "blender": write_blender(scene, root / "blender"),
        "nerfstudio": write_nerfstudio(scene, root / "nerfstudio"),
        "packed": write_packed(scene, root / "packed"),
        "images": write_images(root / "images"),
        "ply": write_plys(scene, root / "ply"),
    }


def load(path: Path) -> None:
    """Load a scene and check what the trainer relies on."""
    scene = load_scene(path, test_every=0, init_num_pts=50)
    assert scene.train and len(scene.points) >= 4 and scene.points.isfinite().all()
    assert 0 < scene.scene_scale < float("inf") and len(scene.points) == len(scene.points_rgb)
    for view in scene.train + scene.test:
        check_view(view, path)
        assert view.image.dtype == torch.uint8 and view.image.shape == (view.height, view.width, 3)
        assert view.mask is None or view.mask.shape == (view.height, view.width)
        assert view.K.dtype == view.viewmat.dtype == torch.float32


def write_colmap(scene: Scene, root: Path) -> Path:
    """Write a text model with one pinhole and one distorted camera, points seen by two images each, and a mask."""
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
        seen = " ".join(f"{k % 20}.5 {k % 16}.5 {k + 1}" for k in range(len(scene.points)) if i < 2)
        lines += [f"{i + 1} {pose} {2 if i == 3 else 1} {view.name}", seen]
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
    """Write RGBA images and return what a transforms file says of each."""
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
    """Write one picture of each kind; a mutated one must decode to a picture or be refused."""
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
    """Write a model in binary and in text, and a point cloud."""
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
