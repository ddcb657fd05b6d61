"""Switches for work that can be left out without a change of the result. Benchmarks measure what each one saves.

All optimizations are on by default. Images and gradients are equal with and without them, up to the order of float
additions.
"""

from collections.abc import Iterator
from contextlib import contextmanager

# Each optimization is a bit of the kernels' parameter `optimizations`. In C++ its name is in capitals.
OPTIMIZATIONS = {
    "exact_tiles": 1,  # list a Gaussian only in tiles that its ellipse alpha = 1/255 crosses, not in its whole box
    "patch_bounds": 2,  # visit only the patches of a tile that the ellipse reaches
    "saturation": 4,  # stop at patches and tiles whose pixels are all finished
    "zero_gradient": 8,  # in the backward pass, skip patches and tiles whose incoming gradient is zero
    "visible_only": 16,  # evaluate SH and its adjoint only for visible Gaussians
    "contributed_only": 32,  # run the adjoint of SH and projection only for Gaussians that received a gradient
    "spheres": 64,  # cull 16 Gaussians at once that lie outside the image even as spheres of their longest axis
    "two_pass": 128,  # list deep Gaussians in a second pass, only in tiles that are still open
}

_active = sum(OPTIMIZATIONS.values())


def active_optimizations() -> int:
    """Return the bit mask of the optimizations in use."""
    return _active


@contextmanager
def without_optimizations(*names: str) -> Iterator[None]:
    """Turn optimizations off inside the `with` statement, for benchmarks and for tests that compare both results.

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
