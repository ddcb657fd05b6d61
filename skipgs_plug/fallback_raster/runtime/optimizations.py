"""Work that a scene does not need, and the switches with which benchmarks measure what leaving it out saves.

All optimizations are on and none changes the result: images and gradients are equal with and without, up to the order
in which float additions happen.
"""

from collections.abc import Iterator
from contextlib import contextmanager

# Each has a bit of the int that kernels read from their parameter `optimizations`; there its name is in capitals.
OPTIMIZATIONS = {
    "exact_tiles": 1,  # list a Gaussian only in tiles that its ellipse at alpha 1/255 crosses, not in its whole box
    "patch_bounds": 2,  # visit only the patches of a tile that the ellipse reaches
    "saturation": 4,  # leave patches and tiles whose pixels are all finished
    "zero_gradient": 8,  # leave patches and tiles whose incoming gradient is zero in the backward pass
    "visible_only": 16,  # evaluate SH and its adjoint only for Gaussians on screen
    "contributed_only": 32,  # run the adjoint of SH and projection only for Gaussians that received a gradient
    "spheres": 64,  # leave out 16 Gaussians at once that lie outside the image even as spheres
    "two_pass": 128,  # list what lies deep behind others only where pixels turn out to need it
}

_active = sum(OPTIMIZATIONS.values())


def active_optimizations() -> int:
    """The optimizations in use as a bit mask."""
    return _active


@contextmanager
def without_optimizations(*names: str) -> Iterator[None]:
    """Renders without some optimizations inside a `with` block, for benchmarks and as a second oracle of the tests.

    Raises:
        ValueError: There is no optimization of that name.
    """
    global _active
    unknown = set(names) - set(OPTIMIZATIONS)
    if unknown:
        raise ValueError(f"Unknown optimizations {sorted(unknown)}; there are {', '.join(OPTIMIZATIONS)}.")
    before = _active
    for name in names:
        _active &= ~OPTIMIZATIONS[name]
    try:
        yield
    finally:
        _active = before
