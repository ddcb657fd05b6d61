"""Gaussian Opacity Fields: Mip-Splatting's 3D filter, and terms on depths and normals in the loss."""

from __future__ import annotations

from skipgs_plug.adapters.inria import InriaFamily
from skipgs_plug.core.trainer_info import Densification


class GOF(InriaFamily):
    """The gate decides on the whole loss; its terms on normals and distortion are constant from iteration 15,000 on.

    `compute_3D_filter` goes on every hundredth iteration, skipped or not. It follows from positions and cameras alone.
    """

    name = "gof"
    checked = "autonomousvision/gaussian-opacity-fields 5245b20 (its loop read, and a look-alike: no stand-in)"
    project = "[GOF](https://github.com/autonomousvision/gaussian-opacity-fields)"
    gated = "From `densify_until_iter` on; decided on the whole loss, with normals and distortion."
    with_share = (
        "By visits. Pictures for inspection, which come with them every 100 iterations, are left out with them."
    )
    left_alone = (
        "The 3D filter is computed anew every hundredth iteration, skipped or not: where nothing moved it is what it "
        "was. Needs CUDA: `--cpu` has no stand-in for its rasterizer."
    )
    mark = "depth_normal_from_iter"
    calls = ("compute_3D_filter", "get_apperance_embedding")
    arguments = ("kernel_size",)
    # Its pictures for inspection come every `densification_interval` as well.
    densification = Densification(marks=("iteration > opt.densify_from_iter",))
