"""Find the most likely reason why a reconstruction did not place a photograph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from skipgs_plug.photos.gather import Gathered
from skipgs_plug.photos.links import Links
from skipgs_plug.photos.video import sharpness
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.scene import BLACK

# Shares of the median of the placed photographs, for the number of features and for sharpness. A photograph below them
# counts as poor in features or as blurred. They only choose the reason that is printed.
FEW_FEATURES = 0.25
BLURRED = 0.25
# Number of placed photographs whose sharpness is measured for the median. It is small because each must be decoded.
SAMPLE = 15


def explain_unplaced(photos: Gathered, models: Sequence[Any], links: Links) -> dict[str, str]:
    """Return the most likely reason for each photograph that the first, largest of `models` does not hold."""
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
            reasons[name] = "is blurred, compared with the others"
        elif links.features[name] < FEW_FEATURES * usual_features:
            reasons[name] = f"shows too few details ({links.features[name]:,} features, usually {usual_features:,.0f})"
        elif name in elsewhere:
            size = models[elsewhere[name] - 1].num_reg_images()
            reasons[name] = f"belongs to a separate group of {size} that shares too little with the rest"
        elif not links.matched[name]:
            reasons[name] = "overlaps no other photograph"
        elif not links.matched[name] & placed:
            reasons[name] = "overlaps only photographs that were not placed either"
        else:
            reasons[name] = "matches placed photographs, but too few of their 3D points"
    return reasons


def sharpness_of(photos: Gathered, name: str) -> float:
    """Return the sharpness of a photograph; see `sharpness`."""
    pixels, _ = read_image(photos.folder / name, name, BLACK)
    return sharpness(pixels.numpy())
