"""The one place that imports pycolmap, whose codecs clash with Pillow's when they come first."""

from __future__ import annotations

from typing import Any

from skipgs_plug.trainer.errors import InputError


def import_pycolmap() -> Any:
    """Return the module, with Pillow loaded before it.

    Both bring their own libpng. With pycolmap's loaded first, Pillow's first PNG written ends in a double free.

    Raises:
        InputError: pycolmap is not installed.
    """
    try:
        import PIL.Image
        import PIL.PngImagePlugin  # noqa: F401
        import pycolmap
    except ImportError as error:
        raise InputError(
            f"Cameras of photographs need pycolmap ({error}); run: pip install 'skipgs_plug[full]'."
        ) from error
    return pycolmap
