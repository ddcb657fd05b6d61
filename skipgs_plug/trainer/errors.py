"""The errors of the reference trainer: each carries one sentence that names the thing and the fix."""

from __future__ import annotations


class InputError(ValueError):
    """A scene, point cloud, checkpoint, PLY file or option that cannot be used."""


class MissingFileError(InputError, FileNotFoundError):
    """A file or folder that should exist and does not."""


class DamagedCheckpointError(InputError):
    """A checkpoint is damaged; an older one may be sound."""


def reason(error: BaseException) -> str:
    """Return a library's error as part of a sentence: its first line, or its type, up to 200 characters."""
    text = str(error).strip().partition("\n")[0] or type(error).__name__
    return text if len(text) <= 200 else text[:197] + "..."
