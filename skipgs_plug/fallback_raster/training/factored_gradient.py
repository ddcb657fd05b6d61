"""The gradient of the higher SH bands in factors: each row is an outer product that is never written out.

The colour of a Gaussian is linear in its SH coefficients. So their gradient is the outer product of the basis functions
in the direction from the camera and the gradient of the colour: 3 + 3 numbers instead of 45.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..runtime.buffers import floats, zeros
from ..runtime.constants import HIGHER_COEFFICIENTS
from ..stages.sh import sh_bands


class Factors(NamedTuple):
    """The non-zero rows of a gradient [N, K, 3], as factors of outer products.

    Attributes:
        rows: [M] int32, row numbers without repetition.
        directions: [M, FACTOR_FLOATS] float32, unit vectors in the first three columns; undefined where the row of
            `colors` is zero.
        colors: [M, FACTOR_FLOATS] float32, gradients of the colours in the first three columns.
        degree: Highest SH degree that has a gradient. The gradient of higher degrees is zero.
    """

    rows: Tensor
    directions: Tensor
    colors: Tensor
    degree: int


class FactoredGradient(Tensor):
    """A gradient [N, K, 3] in factors. Torch treats it as a dense tensor. Changing it in place makes it dense."""

    _content: list[Factors | Tensor]  # a single element, shared with detached copies

    @staticmethod
    def __new__(cls, shape: torch.Size, content: list[Factors | Tensor]) -> "FactoredGradient":
        made: FactoredGradient = Tensor._make_wrapper_subclass(
            cls, shape, dtype=torch.float32, device=torch.device("cpu")
        )
        made._content = content
        return made

    @property
    def factors(self) -> Factors | None:
        """The factors; None once the gradient was changed in place."""
        (content,) = self._content
        return None if isinstance(content, Tensor) else content

    def dense(self) -> Tensor:
        """Return all elements [N, K, 3] as a plain tensor."""
        (content,) = self._content
        if isinstance(content, Tensor):
            return content
        rows, directions, colors, degree = content
        bands = floats(len(rows), HIGHER_COEFFICIENTS)
        sh_bands(directions=directions, bands=bands, n=len(rows), degree=degree)
        product = bands[:, : self.shape[1], None] * colors[:, None, :3]
        product = torch.where((colors[:, :3] != 0).any(1)[:, None, None], product, 0.0)
        return zeros(*self.shape).index_copy_(0, rows.long(), product)

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        """Run operations on the dense tensor. Copies stay factors. An operation in place stores the dense tensor."""
        if func is torch.ops.aten.detach.default:
            return cls(args[0].shape, args[0]._content)
        if func is torch.ops.aten.clone.default and args[0].factors is not None:
            return cls(args[0].shape, list(args[0]._content))
        changed = args[0] if func._schema.is_mutable and isinstance(args[0], cls) else None
        if changed is not None:
            changed._content[0] = changed.dense()
        result = func(*torch.utils._pytree.tree_map(plain, args), **torch.utils._pytree.tree_map(plain, kwargs or {}))
        return result if changed is None else changed


def plain(value: Any) -> Any:
    """Return the dense tensor of a `FactoredGradient`, and any other value unchanged."""
    return value.dense() if isinstance(value, FactoredGradient) else value
