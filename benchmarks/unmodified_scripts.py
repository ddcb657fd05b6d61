"""Other projects' own scripts, run by `skipgs-plug run`: their scenes, what their models show, and the table of it.

    python benchmarks/unmodified_scripts.py scene ../shared/data/bonsai OUT --keep-every 5 --factors 4 8
    python benchmarks/unmodified_scripts.py measure MODEL.ply SCENE --data-factor 8
    python benchmarks/unmodified_scripts.py pictures OUT/test/ours_3000
    python benchmarks/unmodified_scripts.py table benchmarks/results/scripts/runs.json

Every script is measured alike: its PLY is rendered by this package from the held-out cameras. A PLY of Mip-Splatting
has its 3D filter as a property; the filter is applied, with its own 2D filter of 0.1 square pixels. Where no PLY holds
the model in the scene's coordinates (Scaffold-GS, gsplat) it is measured by the pictures that its script has written,
in 8 bits.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from PIL import Image
from torch import Tensor

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.trainer.loaders import load_scene
from skipgs_plug.trainer.metrics import chosen, measure
from skipgs_plug.trainer.ply import read_ply

MIP_FILTER = 0.1  # square pixels, that Mip-Splatting trains with


def thin_scene(
    source: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    keep_every: int = 1,
    points: int = 4000,
    factors: tuple[int, ...] = (4,),
    seed: int = 0,
) -> None:
    """Thin out a COLMAP scene: every nth photograph by name, some of its points, smaller images.

    Args:
        source: COLMAP folder.
        out: Folder to write.
        keep_every: Every nth photograph by name is kept.
        points: Points that are kept, drawn from those in two kept photographs or more.
        factors: Sizes of images, as images_{factor}.
        seed: Of the draw.
    """
    import pycolmap

    model = pycolmap.Reconstruction(str(source / "sparse/0"))
    images = sorted(model.images.values(), key=lambda image: image.name)
    kept = {image.image_id: image.name for image in images[::keep_every]}
    for image in images:
        if image.image_id not in kept:
            model.deregister_frame(image.frame_id)
    shared = [
        number
        for number in sorted(model.points3D)
        if len({element.image_id for element in model.points3D[number].track.elements} & kept.keys()) >= 2
    ]
    drawn = np.random.default_rng(seed).choice(shared, min(points, len(shared)), replace=False)
    for number in sorted(set(model.points3D) - set(drawn.tolist())):
        model.delete_point3D(number)
    (out / "sparse/0").mkdir(parents=True)
    model.write(str(out / "sparse/0"))
    for factor in (1, *factors):
        folder = out / ("images" if factor == 1 else f"images_{factor}")
        folder.mkdir()
        for name in kept.values():
            photograph = source / "images" / name
            if factor == 1:
                shutil.copy(photograph, folder / name)
                continue
            image = Image.open(photograph).convert("RGB")
            size = (round(image.width / factor), round(image.height / factor))
            image.resize(size, Image.Resampling.LANCZOS).save(folder / name, quality=97)
    print(f"{out}: {len(kept)} photographs, {len(model.points3D):,} points")


@torch.no_grad()
def measure_ply(path: Path, scene: Path, factor: int) -> dict[str, Any]:
    """Return the means of PSNR and SSIM over the held-out views, their number, and that of the Gaussians."""
    loaded = load_scene(scene, factor)
    splats = loaded.frame.local_splats(read_ply(path))
    scales, opacities = torch.exp(splats["scales"]), torch.sigmoid(splats["opacities"])
    smoothing = smoothing_filter(path)
    if smoothing is not None:
        wider = torch.sqrt(scales**2 + smoothing**2)
        opacities = opacities * (scales / wider).prod(dim=1)
        scales = wider
    colors = torch.cat([splats["sh0"], splats["shN"]], dim=1)
    rows = []
    for view in loaded.test:
        image, _, _ = rasterization(
            splats["means"],
            splats["quats"],
            scales,
            opacities,
            colors,
            view.viewmat[None],
            view.K[None],
            view.width,
            view.height,
            sh_degree=round(colors.shape[1] ** 0.5) - 1,
            eps2d=0.3 if smoothing is None else MIP_FILTER,
            rasterize_mode="classic" if smoothing is None else "antialiased",
        )
        rows.append(measure(chosen(), image[0].clamp(0, 1), view.image.float() / 255))
    return {**means(rows), "gaussians": len(colors)}


def smoothing_filter(path: Path) -> Tensor | None:
    """Return Mip-Splatting's 3D filter as standard deviations [N, 1]; None for a PLY without it."""
    from plyfile import PlyData

    vertices = PlyData.read(str(path))["vertex"]
    if "filter_3D" not in vertices.data.dtype.names:
        return None
    return torch.tensor(np.array(vertices["filter_3D"]), dtype=torch.float32)[:, None]


def measure_pictures(folder: Path) -> dict[str, Any]:
    """Return the means of PSNR and SSIM over pictures, and their number.

    They lie in `renders` and `gt` (Inria's family), or photograph and render side by side in one (gsplat).
    """
    if (folder / "gt").is_dir():
        names = sorted(path.name for path in (folder / "gt").iterdir())
        pairs = [(pixels(folder / "renders" / name), pixels(folder / "gt" / name)) for name in names]
    else:
        pairs = []
        for path in sorted(folder.glob("val_step*.png")):
            photograph, render = pixels(path).chunk(2, dim=1)
            pairs.append((render.contiguous(), photograph.contiguous()))
    return means([measure(chosen(), render, photograph) for render, photograph in pairs])


def pixels(path: Path) -> Tensor:
    """Return a picture as [H, W, 3] in [0, 1]."""
    return torch.from_numpy(np.array(Image.open(path).convert("RGB"))).float() / 255


def means(rows: list[dict[str, float]]) -> dict[str, Any]:
    """Return means by name, and the number of views."""
    return {**{name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}, "views": len(rows)}


def table(runs: list[dict[str, Any]]) -> str:
    """Return one row for each pair of runs, by scene, in the order in which they were recorded."""
    pairs: dict[tuple[str, str, int], dict[str, dict[str, Any]]] = {}
    for run in runs:
        pairs.setdefault((run["scene"], run["script"], run["iterations"]), {})[run["mode"]] = run
    lines: list[str] = []
    for scene in dict.fromkeys(key[0] for key in pairs):
        lines += [
            f"{scene}:",
            "",
            "| script | iterations | run with auto | s | s with auto | % of own | Gaussians | with auto "
            "| PSNR (SSIM) | with auto | difference dB |",
            "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
            *(row(key, pair) for key, pair in pairs.items() if key[0] == scene and {"own", "auto"} <= pair.keys()),
            "",
        ]
    return "\n".join(lines)


def row(key: tuple[str, str, int], pair: dict[str, dict[str, Any]]) -> str:
    """Return a row of the table."""
    own, auto = pair["own"], pair["auto"]
    cells = [
        key[1],
        f"{key[2]:,}",
        f"{auto['iterations_run']:,}",
        f"{own['seconds']:.0f}",
        f"{auto['seconds']:.0f}",
        f"{100 * auto['seconds'] / own['seconds']:.0f}",
        f"{own['gaussians']:,}",
        f"{auto['gaussians']:,}",
        *(f"{run['psnr']:.2f} ({run['ssim']:.4f})" for run in (own, auto)),
        f"{auto['psnr'] - own['psnr']:+.2f}",
    ]
    return f"| {' | '.join(cells)} |"


def print_ply(model: tyro.conf.Positional[Path], scene: tyro.conf.Positional[Path], data_factor: int = 1) -> None:
    """Measure a PLY on the held-out views."""
    print(json.dumps(measure_ply(model, scene, data_factor)))


def print_pictures(folder: tyro.conf.Positional[Path]) -> None:
    """Measure the pictures that a script has written."""
    print(json.dumps(measure_pictures(folder)))


def print_table(runs: tyro.conf.Positional[Path]) -> None:
    """Print the table of recorded runs."""
    print(table(json.loads(runs.read_text(encoding="utf-8"))["runs"]))


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {"scene": thin_scene, "measure": print_ply, "pictures": print_pictures, "table": print_table}
    )
