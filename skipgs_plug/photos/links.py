"""Read the features and matches of photographs from the database of a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from skipgs_plug.trainer.loaders.native import import_pycolmap

LEAST_MATCHES = 15  # least number of verified matches of two neighbours; COLMAP's threshold for mapping


@dataclass
class Links:
    """Features and verified matches, by the name of the photograph.

    Attributes:
        features: Number of features.
        matched: Photographs that share at least one verified match with the photograph.
        neighbours: Photographs that share at least `LEAST_MATCHES` verified matches with the photograph.
    """

    features: dict[str, int]
    matched: dict[str, set[str]]
    neighbours: dict[str, set[str]]


def read_links(database: Path) -> Links:
    """Read the links between all photographs of a COLMAP database."""
    pycolmap = import_pycolmap()
    connection = pycolmap.Database.open(database)
    try:
        names = {image.image_id: image.name for image in connection.read_all_images()}
        features = {name: int(connection.num_keypoints_for_image(key)) for key, name in names.items()}
        matched: dict[str, set[str]] = {name: set() for name in names.values()}
        neighbours: dict[str, set[str]] = {name: set() for name in names.values()}
        pairs, counts = connection.read_two_view_geometry_num_inliers()
        for pair, count in zip(pairs, counts, strict=True):
            first, second = (names[key] for key in pycolmap.pair_id_to_image_pair(pair))
            for partners, least in ((matched, 1), (neighbours, LEAST_MATCHES)):
                if count >= least:
                    partners[first].add(second)
                    partners[second].add(first)
    finally:
        connection.close()
    return Links(features, matched, neighbours)


def largest_group(neighbours: dict[str, set[str]]) -> set[str]:
    """Return the largest set of photographs that are connected, directly or through neighbours."""
    largest: set[str] = set()
    left = set(neighbours)
    while left:
        group: set[str] = set()
        reached = {left.pop()}
        while reached:
            group |= reached
            reached = set().union(*(neighbours[name] for name in reached)) - group
        left -= group
        largest = max(largest, group, key=len)
    return largest
