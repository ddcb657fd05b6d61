"""`skipgs-plug export MODEL OUT`: a trained model in the formats of web viewers."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from skipgs_plug.commands.options.export import Args
from skipgs_plug.trainer import compressed_ply
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.files import write_aside
from skipgs_plug.trainer.frame import is_far
from skipgs_plug.trainer.ply import write_ply
from skipgs_plug.view import sog, spz
from skipgs_plug.view.model import is_antialiased, open_snapshots

log = logging.getLogger(__name__)

GSPLATS = {".compressed.ply": "ply_compressed", ".splat": "splat"}  # names for gsplat.export_splats
OURS = {".spz": spz.to_spz, ".sog": sog.to_sog}
ENDINGS = (*GSPLATS, *OURS, ".ply")


def run(args: Args) -> int:
    """Convert a model; see `Args`."""
    out = args.out.expanduser()
    ending = next((ending for ending in ENDINGS if out.name.lower().endswith(ending)), None)
    if ending is None:
        known = f"{', '.join(ENDINGS[:-1])} or {ENDINGS[-1]}"
        raise InputError(f"{out} has an unknown ending; use {known}.")
    source = Path(args.model).expanduser()
    splats = open_snapshots(source)[-1].load()
    if ending == ".ply":
        write_ply(splats, out)
    else:
        means = splats["means"]
        if ending in OURS:
            data = OURS[ending](splats, is_antialiased(source))
        else:
            data = exported({**splats, "means": means.float()}, GSPLATS[ending])
        with write_aside(out) as temporary:
            temporary.write_bytes(data)
        if means.dtype == torch.float64 or (ending == ".spz" and is_far(means.numpy())):
            log.warning(
                "%s: so far from the origin, positions are rounded by up to %.2g units. A .ply keeps them.",
                *(out, rounding(means, ending, out)),
            )
    print(f"{len(splats['means']):,} Gaussians, {out.stat().st_size / 2**20:.1f} MiB: {out}")
    return 0


def rounding(means: Tensor, ending: str, out: Path) -> float:
    """Return the largest error of a coordinate of positions [N, 3] in a written file, in their units."""
    if ending == ".spz":
        return spz.position_error(means)
    single = float(means.abs().max()) * 2.0**-24
    if ending == ".sog":
        return max(single, sog.position_error(means))  # readers take the positions as float32
    return single + (compressed_ply.position_error(out) if ending == ".compressed.ply" else 0.0)


def exported(splats: Mapping[str, Tensor], name: str) -> bytes:
    """Return a model in one of the formats of `gsplat.export_splats`."""
    from gsplat import export_splats

    return export_splats(**splats, format=name)
