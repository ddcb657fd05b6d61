"""The settings of a call, as the CUDA modules define them: Inria's fields, and where a fork inserts its own."""

from __future__ import annotations

from collections import namedtuple
from typing import Any

# Fields of Inria's `GaussianRasterizationSettings`, in the order of its positional arguments.
BASE_FIELDS = (
    "image_height",  # pixels
    "image_width",  # pixels
    "tanfovx",  # tangent of half the field of view
    "tanfovy",
    "bg",  # [3]
    "scale_modifier",
    "viewmatrix",  # [4, 4] world to camera, transposed
    "projmatrix",  # [4, 4] world to clip space, transposed
    "sh_degree",
    "campos",  # [3] world space
    "prefiltered",
    "debug",
)


def settings_class(after: dict[str, tuple[str, ...]], defaults: tuple[Any, ...] = ()) -> Any:
    """Return a `GaussianRasterizationSettings`, a named tuple.

    Args:
        after: Fields of a fork, by the base field that they follow.
        defaults: Values of the last fields, for calls that leave them out.

    Raises:
        ValueError: Fields follow a name that is not a base field.

    Example:
        >>> settings_class({"campos": ("mult",)})._fields[9:]
        ('campos', 'mult', 'prefiltered', 'debug')
    """
    if unknown := after.keys() - set(BASE_FIELDS):
        raise ValueError(f"No base field {', '.join(sorted(unknown))}; expected one of {', '.join(BASE_FIELDS)}.")
    fields = [name for base in BASE_FIELDS for name in (base, *after.get(base, ()))]
    return namedtuple("GaussianRasterizationSettings", fields, defaults=defaults)  # type: ignore[misc]
