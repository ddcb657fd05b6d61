"""The gradient of the higher bands as it comes about: of each row an outer product, which nobody has to write down.

The colour of a Gaussian is linear in its coefficients, so their gradient is the basis in the direction from the camera
times the gradient of the colour: 3 and 3 numbers instead of 45.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..runtime.buffers import floats, zeros
from ..runtime.constants import BANDS
from ..stages.sh import sh_bands


class Factors(NamedTuple):
    """Rows of a gradient [N, K, 3] that are not zero, and what they are products of.

    Attributes:
        rows: [M] int32, none of them twice.
        directions: [M, FACTOR] float32, of which the first three count, of length 1; undefined where a row of `colors`
            is zero.
        colors: [M, FACTOR] float32, of which the first three count.
        degree: of the SH that have a gradient; that of higher bands is zero.
    """

    rows: Tensor
    directions: Tensor
    colors: Tensor
    degree: int


class FactoredGradient(Tensor):
    """A gradient [N, K, 3] in factors. To torch it is a dense tensor, which it becomes when it is changed in place."""

    _content: list[Factors | Tensor]  # one thing, shared with what was detached from this

    @staticmethod
    def __new__(cls, shape: torch.Size, content: list[Factors | Tensor]) -> "FactoredGradient":
        made: FactoredGradient = Tensor._make_wrapper_subclass(
            cls, shape, dtype=torch.float32, device=torch.device("cpu")
        )
        made._content = content
        return made

    @property
    def factors(self) -> Factors | None:
        """What it is made of, until it was changed in place."""
        (content,) = self._content
        return None if isinstance(content, Tensor) else content

    def dense(self) -> Tensor:
        """All its numbers, as a plain tensor."""
        (content,) = self._content
        if isinstance(content, Tensor):
            return content
        rows, directions, colors, degree = content
        bands = floats(len(rows), BANDS)
        sh_bands(directions=directions, bands=bands, n=len(rows), degree=degree)
        product = bands[:, : self.shape[1], None] * colors[:, None, :3]
        product = torch.where((colors[:, :3] != 0).any(1)[:, None, None], product, 0.0)
        return zeros(*self.shape).index_copy_(0, rows.long(), product)

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:  # type: ignore[override]
        """Operations see the dense tensor; copies stay factors, and what changes it keeps what it is then."""
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
    """What is dense of a `FactoredGradient`, and all else as it is."""
    return value.dense() if isinstance(value, FactoredGradient) else value
