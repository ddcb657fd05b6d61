"""Runs other projects' scripts with `skipgs-plug run`: makes their scenes, and measures their models.

    python benchmarks/unmodified_scripts.py scene ../shared/data/bonsai OUT --keep-every 5 --factors 4 8
    python benchmarks/unmodified_scripts.py run fastgs auto CHECKOUTS OUT --data-factor 4  # one row of script_rows.py
    python benchmarks/unmodified_scripts.py measure MODEL.ply SCENE --data-factor 8
    python benchmarks/unmodified_scripts.py pictures OUT/test/ours_3000
    python benchmarks/script_table.py benchmarks/results/scripts/runs.json > benchmarks/results/scripts/table.md

These scripts fix their seeds, except that of pip gaussian-splatting, whose order of views is another one in each run.
A second run starts from another draw of the scene's points (`scene --seed 1`).
All scripts are measured alike: this package renders their PLY from the held-out cameras. A PLY of Mip-Splatting
contains a 3D filter, which is applied together with its 2D filter of 0.1 square pixels. For scripts without a PLY in
the scene's coordinates (Scaffold-GS, gsplat, nerfstudio) the pictures that the project wrote are measured, in 8 bits.
"""

import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from PIL import Image
from torch import Tensor

from benchmarks.pictures import find_pictures, means, measure_pictures
from benchmarks.script_rows import ROWS, Row, schedule
from benchmarks.sized_scene import sized_scene
from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.files import write_aside
from skipgs_plug.trainer.loaders import load_scene
from skipgs_plug.trainer.metrics import chosen, measure
from skipgs_plug.trainer.ply import read_ply

RUNS = Path(__file__).parent / "results/scripts/runs.json"
MODES = {"own": ["--no-gate"], "auto": ["--share", "auto"]}
DRAWN = "drawn.json"  # file in a scene's folder about the draw of its points
MIP_FILTER = 0.1  # 2D filter that Mip-Splatting trains with, square pixels


def thin_scene(
    source: tyro.conf.Positional[Path],
    out: tyro.conf.Positional[Path],
    keep_every: int = 1,
    points: int = 4000,
    factors: tuple[int, ...] = (4,),
    seed: int = 0,
) -> None:
    """Reduce a COLMAP scene: every nth photograph by name, some of its points, smaller images.

    Args:
        source: COLMAP folder.
        out: Folder to write.
        keep_every: n, to keep every nth photograph by name.
        points: Number of points to keep, drawn from those that at least two kept photographs observe.
        factors: Factors by which images are reduced, to folders images_{factor}.
        seed: Seed of the draw.
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
    (out / DRAWN).write_text(json.dumps({"points": len(drawn), "seed": seed}) + "\n", encoding="utf-8")
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


def run(
    row: tyro.conf.Positional[str],
    mode: tyro.conf.Positional[Literal["own", "auto"]],
    checkouts: tyro.conf.Positional[Path],
    scene: tyro.conf.Positional[Path],
    data_factor: int = 4,
    iterations: int = 3000,
    out: Path = Path("out"),
    runs: Path = RUNS,
    more: str = "",
) -> None:
    """Run the script of a row once, measure its model, and record both. Replaces the record of an equal run.

    Keep other programs off the core (taskset): on a busy core, processor seconds are too high.

    Args:
        row: Name of the row in script_rows.py.
        mode: "auto" runs with the gate, "own" without.
        checkouts: Folder with the checkouts of all projects.
        scene: Folder that the command `scene` wrote.
        data_factor: Factor by which the photographs are reduced.
        iterations: Iterations of the schedule.
        out: Folder for the output of scripts.
        runs: File with the records.
        more: Further options of the script.
    """
    one = ROWS[row]
    folder = (out / f"{row}.{scene.name}.{data_factor}.{iterations}.{mode}").resolve()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    sized = folder / "scene"
    filled = {"scene": scene.resolve(), "factor": data_factor, "out": folder, "sized": sized, **schedule(iterations)}
    filled["training"] = sized
    if "{sized}" in one.command or "{training}" in one.command:
        sized_scene(scene, data_factor, sized, with_held_out="{sized}" in one.command)
    gate = ["run", "auto", "--cpu", *MODES[mode], "--"]
    script = [*shlex.split(one.command.format(**filled)), *shlex.split(more)]
    begun = time.perf_counter()
    child = start([*gate, *script], checkouts / one.folder, folder / "log.txt")
    _, status, used = os.wait4(child.pid, 0)
    code = child.returncode = os.waitstatus_to_exitcode(status)  # Popen did not wait itself
    if code:  # said first: there may be no model to judge
        print(f"The script ended with {code}; its log is {folder / 'log.txt'}.", file=sys.stderr)
    wall = time.perf_counter() - begun
    if one.render:
        render(one.render.format(**filled), checkouts / one.folder, folder / "render.txt")
    try:
        judged = judge(one, folder, scene, data_factor)
    except FileNotFoundError as error:
        sys.exit(f"{error} Nothing was recorded; the script's log is {folder / 'log.txt'}.")
    record = {
        "scene": named(scene, data_factor),
        "points_seed": json.loads((scene / DRAWN).read_text(encoding="utf-8"))["seed"],
        "script": one.label,
        "mode": mode,
        "iterations": iterations,
        "seconds": round(used.ru_utime + used.ru_stime, 1),
        "wall_seconds": round(wall, 1),
        "peak_rss_gib": round(used.ru_maxrss / 2**20, 2),
        "exit_code": code,
        **facts(folder, iterations),
        **judged,
        "project": one.project,
        "project_commit": commit_of(checkouts / one.folder),
        "command": shlex.join(["skipgs-plug", *gate, *script])
        .replace(str(folder), "OUT")
        .replace(str(scene.resolve()), scene.name),
        "package_commit": commit_of(Path(__file__).parent),
    }
    keep(record, runs)
    print(json.dumps(record, indent=1))


def start(arguments: list[str], checkout: Path, log: Path) -> subprocess.Popen[bytes]:
    """Start `skipgs-plug` in a checkout, with its output in a file."""
    with log.open("w") as output:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "skipgs_plug", *arguments],
            cwd=checkout,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )


def render(command: str, checkout: Path, log: Path) -> None:
    """Run the project's command that renders the held-out views of a trained model, in both modes without a gate."""
    code = start(["run", "auto", "--cpu", "--no-gate", "--", *shlex.split(command)], checkout, log).wait()
    if code:
        print(f"Rendering ended with {code}; its log is {log}.", file=sys.stderr)


def judge(row: Row, folder: Path, scene: Path, factor: int) -> dict[str, Any]:
    """Return PSNR, SSIM, and the numbers of held-out views and of Gaussians (None if no file of the model is known)."""
    if not row.pictures:
        return measure_ply(newest(folder, "point_cloud*.ply"), scene, factor)
    return {**measure_pictures(find_pictures(folder)), "gaussians": count_gaussians(folder)}


def count_gaussians(folder: Path) -> int | None:
    """Return the number of Gaussians in a script's last PLY, or else in nerfstudio's last checkpoint."""
    from plyfile import PlyData

    if any(folder.rglob("point_cloud*.ply")):
        return PlyData.read(str(newest(folder, "point_cloud*.ply")))["vertex"].count
    if any(folder.rglob("step-*.ckpt")):
        state = torch.load(newest(folder, "step-*.ckpt"), "cpu", weights_only=False)  # with NumPy scalars
        return len(state["pipeline"]["_model.gauss_params.means"])
    return None


def newest(folder: Path, pattern: str) -> Path:
    """Return the newest of the files in a folder, and in folders inside it, that have such a name.

    Raises:
        FileNotFoundError: There is none.
    """
    found = max(folder.rglob(pattern), key=lambda path: path.stat().st_mtime, default=None)
    if found is None:
        raise FileNotFoundError(f"There is no {pattern} in {folder}.")
    return found


def facts(folder: Path, iterations: int) -> dict[str, Any]:
    """Return the entries of skipgs.json that are recorded. Without a gate there are few."""
    found = next(iter(folder.rglob("skipgs.json")), None)
    report = {} if found is None else json.loads(found.read_text(encoding="utf-8"))
    growing = report.get("growing") or {}
    left_out = report.get("iterations_skipped", 0) + growing.get("iterations_skipped", 0)
    return {
        "iterations_run": iterations - left_out,
        "refine_share": report.get("refine_share"),
        "ran_for": report.get("ran_for"),
        "grow_share": growing.get("share"),
        "grow_rate_factor": growing.get("rate_factor"),
        "gaussians_shown": report.get("gaussians_shown"),
        "events_run": growing.get("events_run"),
        "events_skipped": growing.get("events_skipped"),
    }


def keep(record: dict[str, Any], runs: Path) -> None:
    """Write a record in place of an equal run. A checkout without git gets the commit of earlier records."""
    whole = json.loads(runs.read_text(encoding="utf-8")) if runs.exists() else {"runs": []}
    if record["project_commit"] is None:
        same = [one["project_commit"] for one in whole["runs"] if one["project"] == record["project"]]
        record["project_commit"] = next(iter(same), None)
    key = ("scene", "points_seed", "script", "mode", "iterations")
    equal = [i for i, one in enumerate(whole["runs"]) if all(one[name] == record[name] for name in key)]
    if equal:
        whole["runs"][equal[0]] = record
    else:
        whole["runs"].append(record)
    with write_aside(runs) as temporary:
        temporary.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")


def named(scene: Path, factor: int) -> str:
    """Return the name of a scene, its image size and its numbers of views."""
    loaded = load_scene(scene, factor)
    view = loaded.test[0]
    views = f"{len(loaded.train)} training and {len(loaded.test)} held-out views"
    return f"{scene.name} {view.width}x{view.height}, {views}"


def commit_of(folder: Path) -> str | None:
    """Return the commit of a checkout; None if it has no git repository."""
    asked = subprocess.run(["git", "-C", folder, "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return asked.stdout.strip() or None


@torch.no_grad()
def measure_ply(path: Path, scene: Path, factor: int) -> dict[str, Any]:
    """Return means of PSNR and SSIM over the held-out views, and the numbers of views and Gaussians."""
    loaded = load_scene(scene, factor)
    splats = loaded.frame.local_splats(read_ply(path))
    scales, opacities = torch.exp(splats["scales"]), torch.sigmoid(splats["opacities"])
    smoothing = smoothing_filter(path)
    if smoothing is not None:
        smoothing = smoothing / loaded.frame.unit
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
            backgrounds=torch.tensor([loaded.background]),
            eps2d=0.3 if smoothing is None else MIP_FILTER,
            rasterize_mode="classic" if smoothing is None else "antialiased",
        )
        rows.append(measure(chosen(), image[0].clamp(0, 1), view.image.float() / 255))
    return {**means(rows), "gaussians": len(colors)}


def smoothing_filter(path: Path) -> Tensor | None:
    """Return Mip-Splatting's 3D filter as standard deviations [N, 1]; None if the PLY has none."""
    from plyfile import PlyData

    vertices = PlyData.read(str(path))["vertex"]
    if "filter_3D" not in vertices.data.dtype.names:
        return None
    return torch.tensor(np.array(vertices["filter_3D"]), dtype=torch.float32)[:, None]


def print_ply(model: tyro.conf.Positional[Path], scene: tyro.conf.Positional[Path], data_factor: int = 1) -> None:
    """Measure a PLY on the held-out views."""
    print(json.dumps(measure_ply(model, scene, data_factor)))


def print_pictures(folder: tyro.conf.Positional[Path]) -> None:
    """Measure the pictures that a script has written."""
    print(json.dumps(measure_pictures(folder)))


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {"scene": thin_scene, "run": run, "measure": print_ply, "pictures": print_pictures}
    )
