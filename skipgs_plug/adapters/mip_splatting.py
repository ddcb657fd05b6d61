"""Mip-Splatting: a 3D filter beside the parameters, computed anew after densification too."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class MipSplatting(InriaFamily):
    """`compute_3D_filter` goes on every hundredth iteration, skipped or not.

    It follows from positions and cameras alone: where nothing moved, it gives what was there. So it pauses nothing.
    """

    name = "mip_splatting"
    checked = "autonomousvision/mip-splatting dda02ab5 (its script, run on the CPU)"
    mark = "create_offset_gt"

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.densify_until_iter)
