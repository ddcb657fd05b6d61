"""Warnings about files of a scene that are not used."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from skipgs_plug.trainer.loaders.paths import unlisted_images

log = logging.getLogger(__name__)


def warn_of_unlisted_images(folder: Path, listed: Sequence[Path], kind: str) -> None:
    """Warn about images of a folder that the scene does not list: they were not placed, or were added later.

    Args:
        folder: Folder of the images.
        listed: Images of the folder that the scene lists.
        kind: Entries of the scene for images, such as "frames of transforms.json".
    """
    others = unlisted_images(folder, listed)
    if others:
        log.warning(
            "%s: %d of its images are not among the %s and are left out, such as %s.",
            folder,
            len(others),
            kind,
            others[0],
        )


def warn_of_missing_masks(masks: Path, found: Sequence[Path | None]) -> None:
    """Warn about views without a mask if others have one, and about masks without a view."""
    if not masks.is_dir():
        return
    bare = sum(path is None for path in found)
    if bare:
        log.warning("%s: %d of %d views have no mask there, so all their pixels count.", masks, bare, len(found))
        others = unlisted_images(masks, [path for path in found if path is not None])
        if others:
            log.warning("%s: %d masks have no view of that name, such as %s.", masks, len(others), others[0])
