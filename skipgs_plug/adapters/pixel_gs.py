"""Pixel-GS: gradients weighted by pixels and depth while it densifies."""

from __future__ import annotations

from skipgs_plug.adapters.inria import InriaFamily


class PixelGS(InriaFamily):
    """Only densification reads the values that this fork adds to Inria's loop, so the gate need not know them."""

    name = "pixel_gs"
    checked = "zhengzhang01/Pixel-GS 05c9d557 (its script run)"
    project = "[Pixel-GS](https://github.com/zhengzhang01/Pixel-GS)"
    gated = "From `densify_until_iter` on."
    left_alone = "Only densification reads pixel counts and the gradients that they weight."
    stand_ins = "pixel_gs"
    mark = "depth_threshold"
    arguments = ("depth_threshold",)
