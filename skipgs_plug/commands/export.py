"""`skipgs-plug export MODEL OUT`: a trained model in the formats of web viewers."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from skipgs_plug.commands.options.export import Args
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.files import write_aside
from skipgs_plug.trainer.ply import write_ply
from skipgs_plug.view.model import is_antialiased, open_snapshots
from skipgs_plug.view.sog import position_error, to_sog
from skipgs_plug.view.spz import POSITION_BITS, to_spz

log = logging.getLogger(__name__)

GSPLATS = {".compressed.ply": "ply_compressed", ".splat": "splat"}  # names for gsplat.export_splats
OURS = {".spz": to_spz, ".sog": to_sog}
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
        if splats["means"].dtype == torch.float64:
            log.warning(
                "%s holds positions in single precision: they are rounded by up to %.2g units. A .ply keeps them.",
                *(out, rounding(splats["means"], ending)),
            )
            if ending != ".sog":  # .sog positions are relative to the extent
                splats["means"] = splats["means"].float()
        data = OURS[ending](splats, is_antialiased(source)) if ending in OURS else exported(splats, GSPLATS[ending])
        with write_aside(out) as temporary:
            temporary.write_bytes(data)
    print(f"{len(splats['means']):,} Gaussians, {out.stat().st_size / 2**20:.1f} MiB: {out}")
    return 0


def rounding(means: Tensor, ending: str) -> float:
    """Return the largest distance by which a format moves positions [N, 3]."""
    largest = float(means.abs().max())
    if ending == ".sog":
        return max(largest * 2.0**-24, position_error(means))
    return largest * 2.0 ** -(POSITION_BITS if ending == ".spz" else 24)


def exported(splats: Mapping[str, Tensor], name: str) -> bytes:
    """Return a model in one of the formats of `gsplat.export_splats`."""
    from gsplat import export_splats

    return export_splats(**splats, format=name)
