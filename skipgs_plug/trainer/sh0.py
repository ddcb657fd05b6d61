"""Colours as constant SH coefficients, the only part of a Gaussian's colour that does not depend on direction."""

from __future__ import annotations

from typing import Any

SH_C0 = 0.28209479177387814  # value of the constant SH basis function: 1 / (2 sqrt(pi))


def sh0_of(colours: Any) -> Any:
    """Return the coefficients of colours in [0, 1]; both are arrays or tensors of one shape."""
    return (colours - 0.5) / SH_C0


def colours_of_sh0(sh0: Any) -> Any:
    """Return the colours of coefficients, which can be outside of [0, 1]; both are arrays or tensors of one shape."""
    return 0.5 + SH_C0 * sh0
