"""Work that a scene does not need, and the switches with which benchmarks measure what leaving it out saves.

All shortcuts are on and none changes the result: images and gradients are equal with and without, up to the order
in which float additions happen.
"""

from collections.abc import Iterator
from contextlib import contextmanager

# Names in the order of their bits; kernels read them from an int parameter `shortcuts`.
SHORTCUTS = {
    "exact_tiles": "list a Gaussian only in tiles that its ellipse at alpha 1/255 crosses, not in its whole box",
    "block_bounds": "visit only the 4 x 4 blocks of a tile that the ellipse reaches",
    "saturation": "leave blocks and tiles whose pixels are all finished",
    "zero_gradient": "leave blocks and tiles whose incoming gradient is zero in the backward pass",
    "visible_only": "evaluate SH and its adjoint only for Gaussians on screen",
    "contributed_only": "run the adjoint of SH and projection only for Gaussians that received a gradient",
}
VISIBLE_ONLY = 1 << list(SHORTCUTS).index("visible_only")

_ALL = (1 << len(SHORTCUTS)) - 1
_active = _ALL


def active_shortcuts() -> int:
    """The shortcuts in use as a bit mask."""
    return _active


@contextmanager
def without_shortcuts(*names: str) -> Iterator[None]:
    """Renders without some shortcuts inside a `with` block, for benchmarks.

    Raises:
        ValueError: There is no shortcut of that name.
    """
    global _active
    unknown = set(names) - set(SHORTCUTS)
    if unknown:
        raise ValueError(f"Unknown shortcuts {sorted(unknown)}; there are {', '.join(SHORTCUTS)}.")
    before = _active
    _active &= ~sum(1 << bit for bit, name in enumerate(SHORTCUTS) if name in names)
    try:
        yield
    finally:
        _active = before
