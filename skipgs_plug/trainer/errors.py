"""The errors of the reference trainer: each carries one sentence that names the thing and the fix."""

from __future__ import annotations


class InputError(ValueError):
    """A scene, point cloud, checkpoint, PLY file or option that cannot be used."""


class MissingFileError(InputError, FileNotFoundError):
    """A file or folder that should exist and does not."""


class DamagedCheckpointError(InputError):
    """A checkpoint that does not hold what it should; an older one may."""
