"""One running mean of the loss per view."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.views import forget_oldest


class ViewMeans:
    """Exponential running means, seeded with each view's first loss (paper, per-view loss EMA).

    Attributes:
        values: Mean by view key, for at most MAX_VIEWS views. A restored state has string keys; `update` replaces each
            by the key that the loop uses.
    """

    __slots__ = ("_decay", "_gain", "values")

    def __init__(self, decay: float) -> None:
        self._decay = decay
        self._gain = 1.0 - decay
        self.values: dict[Hashable, float] = {}

    def update(self, view: Hashable, loss: float) -> float | None:
        """Update the mean with a finite loss, and return the mean before it; None for a new view."""
        values = self.values
        mean = values.get(view)
        if mean is None and (type(view) is str or (mean := values.pop(str(view), None)) is None):
            values[view] = loss
            forget_oldest(values)
            return None
        values[view] = self._decay * mean + self._gain * loss
        return mean

    def get(self, view: Hashable) -> float | None:
        """Return the mean of a view; None for a new view."""
        mean = self.values.get(view)
        return self.values.get(str(view)) if mean is None else mean

    def __len__(self) -> int:
        return len(self.values)

    def state_dict(self) -> dict[str, float]:
        """Return the means by the text of the view key.

        Raises:
            SkipGSError: Two keys have the same text, such as 6 and "6".
        """
        values = list(self.values.items())  # another thread may train meanwhile
        state = {str(view): mean for view, mean in values}
        if len(state) != len(values):
            raise SkipGSError("Two view keys have the same text; use image names as view keys.")
        return state

    def load_state_dict(self, state: Mapping[Hashable, float]) -> None:
        self.values = {str(view): float(mean) for view, mean in state.items()}
