"""Mip-Splatting: a 3D filter beside the parameters, which is recomputed after densification too."""

from __future__ import annotations

from skipgs_plug.adapters.inria import InriaFamily


class MipSplatting(InriaFamily):
    """`compute_3D_filter` runs every hundredth iteration, skipped or not.

    It depends on positions and cameras only, so it changes nothing if nothing moved, and does not pause the gate.
    """

    name = "mip_splatting"
    checked = "autonomousvision/mip-splatting dda02ab5 (its script run)"
    project = "[Mip-Splatting](https://github.com/autonomousvision/mip-splatting)"
    gated = "From `densify_until_iter` on."
    left_alone = (
        "The 3D filter is computed anew every hundredth iteration, skipped or not. It changes only if the model moves, "
        "so it does not pause the gate."
    )
    stand_ins = "mip_splatting"
    mark = "create_offset_gt"
    arguments = ("kernel_size", "subpixel_offset")
