"""Treatment of NaN and infinite losses, of which the user always hears."""

from __future__ import annotations

from skipgs_plug.core import decision
from skipgs_plug.core.caution import caution
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.errors import BrokenTrainingError, DivergedError

# Least number of non-finite losses in a row that are an error. Fewer can come from single damaged views.
MIN_IN_A_ROW = 10


class NonFiniteGuard:
    """Decides on losses that are not finite, and raises an error if they continue.

    The error ends a loop of the user's own. A gate that an adapter attached is released instead, because some trainers
    recover from such losses by themselves: a loss scaler, for instance, needs the backward passes.

    Args:
        mode: "skip", "raise" or "pass"; see `SkipConfig.on_nonfinite`.

    Attributes:
        in_a_row: Number of non-finite losses since the last finite one.
    """

    def __init__(self, mode: str) -> None:
        self._mode = mode
        self._warned: set[str] = set()
        self.in_a_row = 0

    def answer(self, view: str, loss: float, step: int, mean: float | None, n_views: int) -> Decision:
        """Decide on a loss that is not finite.

        Raises:
            BrokenTrainingError: The mode is "raise".
            DivergedError: As many losses in a row as there are views, at least 10, were not finite.
        """
        known = "no finite loss before" if mean is None else f"mean of its finite losses {mean:.4g}"
        what = f"Loss is {loss} in iteration {step} on view {view!r} ({known})"
        self.in_a_row += 1
        if self._mode == "raise":
            raise BrokenTrainingError(f"{what}: the trainer computed this value; check that image and camera.")
        if self.in_a_row >= max(MIN_IN_A_ROW, n_views):
            raise DivergedError(
                f"{what}, like the {self.in_a_row - 1} losses before it; "
                "if they stay so, resume from a checkpoint with lower learning rates"
            )
        if view not in self._warned:
            self._warned.add(view)
            then = "its backward is skipped" if self._mode == "skip" else "its backward runs all the same"
            caution(f"{what}; {then}.")
        return decision.NON_FINITE if self._mode == "skip" else decision.NON_FINITE_PASSED
