"""Checks of the arguments of `rasterization`. Each refusal is one sentence that names the argument."""

import functools
import math
import numbers
import operator
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

# Most elements of a tensor, and most pixels of an image: kernels index both with 32-bit ints.
MAX_NUMBERS = 2**31 - 1
# Most pixels along a side of an image: kernels compute pixel centres, at +0.5, in float32, which is exact up to 2^23.
MAX_SIDE = 2**23

Shape = tuple[int, ...]


def refuse_unsupported(**used: bool) -> None:
    """Refuse options of gsplat that are used but not supported here.

    Raises:
        NotImplementedError: An option is used. The message names the first.
    """
    for name, in_use in used.items():
        if in_use:
            raise NotImplementedError(f"The CPU rasterizer does not support {name}; leave it at its default.")


def as_float(name: str, value: Any) -> float:
    """Return a real number of any type as a float.

    Raises:
        ValueError: The value is not a number, or is NaN.
    """
    # The first comparison avoids the check against the abstract class, which takes as long as a small kernel.
    if (type(value) is not float and not isinstance(value, numbers.Real)) or math.isnan(value):
        raise ValueError(f"{name} must be a number, got {value!r}.")
    return float(value)


def planes(near_plane: Any, far_plane: Any) -> tuple[float, float]:
    """Return the clipping planes as floats, with the near plane at 0 or more.

    Gaussians behind a camera are never drawn: kernels sort by the bits of depths, which orders only positive depths.

    Raises:
        ValueError: A plane is not a number.
    """
    return max(as_float("near_plane", near_plane), 0.0), as_float("far_plane", far_plane)


def camera_centre(viewmat: Tensor) -> Tensor:
    """Return the position [3] of a camera in world space, given its matrix [4, 4]. Differentiable.

    Raises:
        ValueError: The matrix has no inverse.
    """
    rows = viewmat.tolist()
    if not viewmat.requires_grad and rows[3] == [0.0, 0.0, 0.0, 1.0]:
        # Cramer's rule in float64: torch's checks of the matrix take longer than some kernels run.
        *axes, shift = zip(*rows[:3], strict=True)
        across = [_cross(axes[1], axes[2]), _cross(axes[2], axes[0]), _cross(axes[0], axes[1])]
        volume = _dot(axes[0], across[0])
        if volume != 0.0:
            return torch.tensor([-_dot(shift, c) / volume for c in across], dtype=torch.float32, device="cpu")
    try:
        return torch.linalg.inv(viewmat)[:3, 3]
    except torch.linalg.LinAlgError:
        raise ValueError(f"viewmats must be invertible, got {rows} for a camera.") from None


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def as_kernels_read(*tensors: Tensor) -> list[Tensor]:
    """Return tensors as contiguous float32. Tensors that are so already are returned as they are."""
    return [t if t.dtype is torch.float32 and t.is_contiguous() else t.to(torch.float32).contiguous() for t in tensors]


def as_int(value: Any) -> Any:
    """Return a whole number of any type, such as NumPy's, as an int, and any other value unchanged."""
    try:
        return operator.index(value)
    except TypeError:
        return value


def check_tensors(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    sh_degree: int | None,
    shN: Tensor | None,
    backgrounds: Tensor | None,
    width: int,
    height: int,
) -> None:
    """Check types, devices and shapes as `rasterization` documents them, and sizes against the limits of the kernels.

    Raises:
        ValueError: An argument does not fit. The message names it.
    """
    tensors = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "Ks": Ks,
    }
    if backgrounds is not None:
        tensors["backgrounds"] = backgrounds
    if shN is not None:
        tensors["colors[1]"] = shN
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise ValueError(f"{name} must be a floating point tensor, got {kind}.")
        if not tensor.is_cpu:
            raise ValueError(f"{name} is on {tensor.device}, but this rasterizer runs on the CPU: use {name}.cpu().")
    if sh_degree is not None and (type(sh_degree) is not int or sh_degree not in (0, 1, 2, 3)):
        raise ValueError(f"sh_degree must be 0 to 3 on the CPU, got {sh_degree!r}.")
    if not (isinstance(width, int) and isinstance(height, int) and width > 0 and height > 0):
        raise ValueError(f"width and height must be whole numbers of at least 1, got {width!r} and {height!r}.")
    shapes = (None if t is None else t.shape for t in (means, quats, scales, opacities, colors, viewmats, Ks, shN))
    _check_shapes(*shapes, None if backgrounds is None else backgrounds.shape, sh_degree, width, height)
    for name, cameras in (("viewmats", viewmats), ("Ks", Ks)):
        if not all(math.isfinite(number) for camera in cameras.tolist() for row in camera for number in row):
            raise ValueError(f"{name} holds NaN or infinity: a camera must be finite.")


@functools.lru_cache(maxsize=64)  # shapes of the last images: checking them again takes as long as a small kernel
def _check_shapes(
    means: Shape,
    quats: Shape,
    scales: Shape,
    opacities: Shape,
    colors: Shape,
    viewmats: Shape,
    Ks: Shape,
    shN: Shape | None,
    backgrounds: Shape | None,
    sh_degree: int | None,
    width: int,
    height: int,
) -> None:
    if len(means) != 2 or means[1] != 3:
        raise ValueError(f"means must have shape [N, 3] (no batch dimensions), got {list(means)}.")
    n = means[0]
    if len(viewmats) != 3:
        raise ValueError(f"viewmats must have shape [C, 4, 4], got {list(viewmats)}.")
    n_cameras = viewmats[0]
    expected = {
        "quats": (quats, [n, 4]),
        "scales": (scales, [n, 3]),
        "opacities": (opacities, [n]),
        "viewmats": (viewmats, [n_cameras, 4, 4]),
        "Ks": (Ks, [n_cameras, 3, 3]),
    }
    for name, (found, wanted) in expected.items():
        if list(found) != wanted:
            raise ValueError(f"{name} must have shape {wanted}, got {list(found)}.")
    if n_cameras == 0:
        raise ValueError("viewmats must hold at least one camera, got none.")
    shape = list(colors)
    if sh_degree is None:
        if shape[:-1] not in ([n], [n_cameras, n]) or shape[-1] == 0:
            raise ValueError(f"colors must have shape [{n}, D] or [{n_cameras}, {n}, D], got {shape}.")
        channels = shape[-1]
    else:
        terms = (sh_degree + 1) ** 2
        if shN is not None:
            higher = list(shN)
            if shape != [n, 1, 3] or len(higher) != 3 or higher[0] != n or higher[2] != 3:
                raise ValueError(
                    f"colors as a pair must have shapes [{n}, 1, 3], [{n}, K - 1, 3], got {shape}, {higher}."
                )
            shape = [n, 1 + higher[1], 3]
        if shape[-1:] != [3] or shape[:-2] not in ([n], [n_cameras, n]) or shape[-2] < terms:
            raise ValueError(
                f"colors must have shape [{n}, K, 3] or [{n_cameras}, {n}, K, 3] with K >= {terms} for "
                f"sh_degree={sh_degree}, got {shape}."
            )
        channels = 3
    if backgrounds is not None and list(backgrounds) != [n_cameras, channels]:
        raise ValueError(f"backgrounds must have shape [{n_cameras}, {channels}], got {list(backgrounds)}.")
    if max(width, height) > MAX_SIDE or width * height > MAX_NUMBERS:
        raise ValueError(
            f"An image may have at most {MAX_SIDE:,} pixels along a side and {MAX_NUMBERS:,} in all, "
            f"got {width}x{height}."
        )
    widest = max(4, channels if sh_degree is None else 3) + 1  # columns of quaternions, or of colours and depth
    if n * widest > MAX_NUMBERS:
        raise ValueError(f"{n:,} Gaussians with {widest} numbers each are more than {MAX_NUMBERS:,} numbers.")
