"""2D Gaussian Splatting: discs in place of Gaussians, and two more terms in the loss."""

from __future__ import annotations

from skipgs_plug.adapters.inria import InriaFamily


class TwoDGS(InriaFamily):
    """The gate decides on the whole loss, with normal consistency and depth distortion.

    Both weights are constant from iteration 7,000 on. A gate that starts earlier sees losses rise at that iteration,
    and runs the backward passes of a view until its loss is below its mean again.
    """

    name = "2dgs"
    checked = "hbb1/2d-gaussian-splatting 1920a239 (look-alike only: its rasterizer has no stand-in)"
    project = "[2D Gaussian Splatting](https://github.com/hbb1/2d-gaussian-splatting)"
    gated = "From `densify_until_iter` on; decided on the whole loss, with normal consistency and depth distortion."
    left_alone = "Needs CUDA: `--cpu` has no stand-in for its surfel rasterizer."
    mark = "lambda_dist"  # `render_net_image` is none: other forks have its viewer
