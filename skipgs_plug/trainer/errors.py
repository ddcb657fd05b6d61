"""The errors of the reference trainer. Each message is one sentence that names the problem and the fix."""

from __future__ import annotations


class InputError(ValueError):
    """A scene, point cloud, checkpoint, PLY file or option cannot be used."""


class MissingFileError(InputError, FileNotFoundError):
    """A file or folder does not exist."""


class DamagedCheckpointError(InputError):
    """A checkpoint is damaged. An older one may be readable."""


def reason(error: BaseException) -> str:
    """Return a library's error as part of a sentence: its first line, or its type, up to 200 characters."""
    text = str(error).strip().partition("\n")[0] or type(error).__name__
    return text if len(text) <= 200 else text[:197] + "..."
