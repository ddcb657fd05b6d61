"""Gaussian Opacity Fields: Mip-Splatting's 3D filter, and terms on depths and normals in the loss."""

from __future__ import annotations

from skipgs_plug.adapters.inria import RESETS, InriaFamily
from skipgs_plug.core.trainer_info import Densification


class GOF(InriaFamily):
    """The gate decides on the whole loss. The weights of normals and distortion are constant from iteration 15,000 on.

    `compute_3D_filter` runs every hundredth iteration, skipped or not. It depends on positions and cameras only.
    """

    name = "gof"
    checked = "autonomousvision/gaussian-opacity-fields 5245b20 (its loop read, and a look-alike: no stand-in)"
    project = "[GOF](https://github.com/autonomousvision/gaussian-opacity-fields)"
    gated = "From `densify_until_iter` on; decided on the whole loss, with normals and distortion."
    with_share = "By visits. Pictures for inspection are left out together with the events."
    left_alone = (
        "The 3D filter is computed anew every hundredth iteration, skipped or not; it changes only if the model moves. "
        "Needs CUDA: `--cpu` has no stand-in for its rasterizer."
    )
    mark = "depth_normal_from_iter"
    calls = ("get_apperance_embedding",)
    arguments = ("kernel_size",)
    # `densification_interval` would match its pictures for inspection, too.
    densification = Densification(marks=("iteration > opt.densify_from_iter",), reset_marks=RESETS)
