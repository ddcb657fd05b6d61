"""Photographs that a reconstruction did not place, and the likeliest reason for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from skipgs_plug.photos.gather import Gathered
from skipgs_plug.photos.links import Links
from skipgs_plug.photos.video import sharpness
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.scene import BLACK

# A photograph that was not placed counts as poor in features, or as blurred, below these shares of the median of placed
# photographs. They only choose the reason that is printed.
FEW_FEATURES = 0.25
BLURRED = 0.25
SAMPLE = 15  # placed photographs whose sharpness is measured for the median: each must be decoded


def explain_unplaced(photos: Gathered, models: Sequence[Any], links: Links) -> dict[str, str]:
    """Return, for each photograph that the first of `models` does not hold, the likeliest reason."""
    placed = {image.name for image in models[0].images.values() if image.has_pose}
    missing = [name for name in photos.names if name not in placed]
    if not missing:
        return {}
    elsewhere = {
        image.name: number
        for number, model in reversed(list(enumerate(models[1:], start=2)))
        for image in model.images.values()
        if image.has_pose
    }
    usual_features = float(np.median([links.features[name] for name in placed]))
    sample = sorted(placed)[:: max(1, len(placed) // SAMPLE)]
    usual_sharpness = float(np.median([sharpness_of(photos, name) for name in sample]))
    reasons = {}
    for name in missing:
        if sharpness_of(photos, name) < BLURRED * usual_sharpness:
            reasons[name] = "blurred, compared with the others"
        elif links.features[name] < FEW_FEATURES * usual_features:
            reasons[name] = (
                f"shows little to hold on to ({links.features[name]:,} features, usually {usual_features:,.0f})"
            )
        elif name in elsewhere:
            size = models[elsewhere[name] - 1].num_reg_images()
            reasons[name] = f"belongs to a separate group of {size} that shares too little with the rest"
        elif not links.matched[name]:
            reasons[name] = "overlaps no other photograph"
        elif not links.matched[name] & placed:
            reasons[name] = "overlaps only photographs that were not placed either"
        else:
            reasons[name] = "matches others, but too few of their points in space"
    return reasons


def sharpness_of(photos: Gathered, name: str) -> float:
    pixels, _ = read_image(photos.folder / name, name, BLACK)
    return sharpness(pixels.numpy())
