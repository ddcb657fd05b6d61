"""The order of training views: every view once per shuffled epoch."""

from __future__ import annotations

import torch


class ViewOrder:
    """View index as a pure function of seed and iteration, so resuming needs no stored generator state.

    Epoch e is a permutation from a generator seeded with (seed, e). The global generators of torch and numpy are not
    used.
    """

    def __init__(self, n_views: int, seed: int) -> None:
        self.n_views = n_views
        self.seed = seed
        self._epoch = -1
        self._permutation: list[int] = []

    def at(self, step: int) -> int:
        """Return the index of the view for iteration `step` (0-based)."""
        epoch, position = divmod(step, self.n_views)
        if epoch != self._epoch:
            generator = torch.Generator().manual_seed(derive_seed(self.seed, epoch))
            self._permutation = torch.randperm(self.n_views, generator=generator).tolist()
            self._epoch = epoch
        return self._permutation[position]


def derive_seed(seed: int, counter: int) -> int:
    """Return a 63-bit seed for (seed, counter). Neighbouring counters give unrelated random numbers."""
    return (seed * 0x9E3779B97F4A7C15 + counter * 0xD1342543DE82EF95 + 1) % (1 << 63)
