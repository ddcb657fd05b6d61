"""The one import of pycolmap that is safe beside Pillow."""

from __future__ import annotations

from types import ModuleType

from skipgs_plug.trainer.errors import InputError


def import_pycolmap() -> ModuleType:
    """Return pycolmap, with Pillow's libraries loaded first.

    Both bring a libtiff of their own; the other way round, Pillow's decoder frees what it did not allocate.

    Raises:
        InputError: pycolmap is not installed.
    """
    import PIL.Image  # noqa: F401

    try:
        import pycolmap
    except ImportError as error:
        raise InputError(f"pycolmap cannot be imported ({error}); run: pip install 'skipgs_plug[train]'.") from error
    return pycolmap  # type: ignore[no-any-return]
