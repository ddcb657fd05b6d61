"""Structure from motion with pycolmap: features, matches, mapping, undistortion."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from skipgs_plug.photos import global_mapping
from skipgs_plug.photos.choices import Mapping, Matching
from skipgs_plug.photos.gather import Gathered
from skipgs_plug.photos.links import Links, largest_group, read_links
from skipgs_plug.photos.progress import counted
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.loaders.photograph import undistort

# Largest number of photographs whose pairs are all compared. With more, this takes longer than comparing neighbours.
EXHAUSTIVE_UP_TO = 100
OVERLAP = 10  # neighbours on either side with which a photograph is compared; then those 16, 32, ... away
# Number of photographs of a sequence that are all compared with each other, because a walk returns to earlier places.
KEY_PHOTOGRAPHS = 40
# Largest number of photographs that are placed one after another. Up to it, this is quick and keeps more points.
ALL_AT_ONCE_BEYOND = 100
# Share of the largest group of connected photographs that global mapping must place. If it places fewer, incremental
# mapping is tried.
ENOUGH = 0.9
FEATURE_SIZE = 1600  # longer side in pixels for feature detection; larger photographs gain little
SEED = 0  # seed of COLMAP's random numbers

Progress = Callable[[int], None]


class Reconstruction:
    """A reconstruction in progress. Its database and models are in the folder `work`.

    Each step calls `progress` with the number of photographs (for matching: pairs) that finished since the last call.
    """

    def __init__(self, photos: Gathered, work: Path) -> None:
        self._colmap = import_pycolmap()
        # COLMAP's messages are not needed: errors that matter are raised or counted here.
        self._colmap.logging.minloglevel = int(self._colmap.logging.FATAL)
        self._photos = photos
        self._work = work
        self.database = work / "database.db"

    def extract(self, progress: Progress) -> None:
        """Detect the features of all photographs and store them in the database."""
        options = self._colmap.FeatureExtractionOptions()
        options.max_image_size = FEATURE_SIZE
        reader = self._colmap.ImageReaderOptions()
        if self._photos.masks is not None:
            reader.mask_path = self._photos.masks
        mode = self._colmap.CameraMode.SINGLE if self._photos.one_camera else self._colmap.CameraMode.AUTO
        with counted(self.database, "descriptors", progress):
            self._colmap.extract_features(
                self.database,
                self._photos.folder,
                self._photos.names,
                camera_mode=mode,
                reader_options=reader,
                extraction_options=options,
            )

    def match(self, matching: Matching, progress: Progress) -> str:
        """Match features and verify the matches geometrically; return the kind of matching that was used."""
        if matching == "auto":
            matching = "exhaustive" if len(self._photos.names) <= EXHAUSTIVE_UP_TO else "sequential"
        verification = self._colmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = SEED
        with counted(self.database, "two_view_geometries", progress):
            if matching == "exhaustive":
                self._colmap.match_exhaustive(self.database, verification_options=verification)
            else:
                options = self._colmap.SequentialPairingOptions()
                options.overlap = OVERLAP
                self._colmap.match_sequential(self.database, pairing_options=options, verification_options=verification)
                pairs = self._colmap.ImportedPairingOptions()
                pairs.match_list_path = self._work / "pairs.txt"
                pairs.match_list_path.write_text(
                    "\n".join(f"{a} {b}" for a, b in key_pairs(self._photos.names)), encoding="utf-8"
                )
                self._colmap.match_image_pairs(self.database, pairing_options=pairs, verification_options=verification)
        return matching

    def links(self) -> Links:
        """Return the features and matches; call it after `match`."""
        return read_links(self.database)

    def resolve(self, mapping: Mapping) -> Mapping:
        """Return "global" or "incremental"; for "auto", decide by the number of photographs."""
        if mapping != "auto":
            return mapping
        return "global" if len(self._photos.names) > ALL_AT_ONCE_BEYOND else "incremental"

    def map_globally(self, progress: Progress) -> list[Any]:
        """Place photographs all at once; return the models, largest first, or an empty list if that failed.

        `progress` is called with the number of finished stages out of `global_mapping.STAGES`.
        """
        return global_mapping.map_globally(self.database, self._photos.folder, self._work / "global", progress)

    def placed_enough(self, models: Sequence[Any]) -> bool:
        """Return whether the largest model holds the share `ENOUGH` of the connected photographs or more."""
        return bool(models) and models[0].num_reg_images() >= ENOUGH * len(largest_group(self.links().neighbours))

    def map_incrementally(self, progress: Progress) -> list[Any]:
        """Place photographs one after another; return the models, largest first, or an empty list if no two fit."""
        options = self._colmap.IncrementalPipelineOptions()
        options.random_seed = SEED
        options.min_model_size = 3
        # Points that only two photographs show are good for the start of training, and are half of all in small sets.
        options.triangulation.ignore_two_view_tracks = False
        output = self._work / "models"
        output.mkdir()
        models = self._colmap.incremental_mapping(
            self.database,
            self._photos.folder,
            output,
            options=options,
            initial_image_pair_callback=lambda: progress(2),
            next_image_callback=lambda: progress(1),
        )
        return sorted(models.values(), key=lambda model: -model.num_reg_images())

    def undistort(self, model: Any) -> Path:
        """Write the photographs of a model without distortion; return the folder with `images` and `sparse`."""
        chosen, output = self._work / "chosen", self._work / "undistorted"
        chosen.mkdir()
        model.write(chosen)
        self._colmap.undistort_images(output, chosen, self._photos.folder, jpeg_quality=97)
        if self._photos.masks is not None:
            self._undistort_masks(model, self._photos.masks, output / "masks")
        return output

    def _undistort_masks(self, model: Any, masks: Path, output: Path) -> None:
        """Write the masks of a model's photographs without distortion, like the photographs."""
        for image in model.images.values():
            source = masks / f"{image.name}.png"
            if not source.is_file():
                continue
            mask = torch.from_numpy(np.array(Image.open(source))) > 0
            straight = undistort(mask[..., None].byte().repeat(1, 1, 3), mask, model.cameras[image.camera_id], source)
            assert straight.mask is not None
            target = output / f"{image.name}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(straight.mask.byte().numpy() * 255).save(target)


def key_pairs(names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield all pairs among photographs that are evenly spread over the sequence. A walk returns to earlier places.

    COLMAP separates the names of a pair by a space, so names that contain white space are left out.
    """
    spread = names[:: max(1, len(names) // KEY_PHOTOGRAPHS)]
    return itertools.combinations([name for name in spread if not any(map(str.isspace, name))], 2)
