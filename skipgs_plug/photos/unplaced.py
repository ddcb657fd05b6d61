"""Which photographs a reconstruction left out, and what its database says about why."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skipgs_plug.photos.gather import Gathered
from skipgs_plug.photos.video import sharpness
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.scene import BLACK

FEW_FEATURES = 0.25  # of the median of the placed photographs
BLURRED = 0.25  # of the median sharpness of the placed photographs
SAMPLE = 15  # placed photographs that the sharpness of the others is compared with


def explain_unplaced(photos: Gathered, models: Sequence[Any], database: Path) -> dict[str, str]:
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
    features, partners = read_links(database)
    usual_features = float(np.median([features[name] for name in placed]))
    sample = sorted(placed)[:: max(1, len(placed) // SAMPLE)]
    usual_sharpness = float(np.median([sharpness_of(photos, name) for name in sample]))
    reasons = {}
    for name in missing:
        if sharpness_of(photos, name) < BLURRED * usual_sharpness:
            reasons[name] = "blurred, compared with the others"
        elif features[name] < FEW_FEATURES * usual_features:
            reasons[name] = f"shows little to hold on to ({features[name]:,} features, usually {usual_features:,.0f})"
        elif name in elsewhere:
            size = models[elsewhere[name] - 1].num_reg_images()
            reasons[name] = f"belongs to a separate group of {size} that shares too little with the rest"
        elif not partners[name]:
            reasons[name] = "overlaps no other photograph"
        elif not partners[name] & placed:
            reasons[name] = "overlaps only photographs that were not placed either"
        else:
            reasons[name] = "matches others, but too few of their points in space"
    return reasons


def read_links(database: Path) -> tuple[dict[str, int], dict[str, set[str]]]:
    """Return, by photograph, its number of features and the photographs with verified matches."""
    pycolmap = import_pycolmap()
    connection = pycolmap.Database.open(database)
    try:
        names = {image.image_id: image.name for image in connection.read_all_images()}
        features = {name: int(connection.num_keypoints_for_image(key)) for key, name in names.items()}
        partners: dict[str, set[str]] = {name: set() for name in names.values()}
        pairs, counts = connection.read_two_view_geometry_num_inliers()
        for pair, count in zip(pairs, counts, strict=True):
            if count:
                first, second = pycolmap.pair_id_to_image_pair(pair)
                partners[names[first]].add(names[second])
                partners[names[second]].add(names[first])
    finally:
        connection.close()
    return features, partners


def sharpness_of(photos: Gathered, name: str) -> float:
    pixels, _ = read_image(photos.folder / name, name, BLACK)
    return sharpness(pixels.numpy())
