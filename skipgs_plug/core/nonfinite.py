"""What a NaN or infinite loss does to the gate: never silently anything."""

from __future__ import annotations

from skipgs_plug.core import decision
from skipgs_plug.core.caution import caution
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.errors import BrokenTrainingError

MIN_IN_A_ROW = 10  # non-finite losses in a row, at least, that make an error: fewer can come from single views


class NonFiniteGuard:
    """Answers for losses that are not finite, and gives up when they go on.

    Args:
        mode: "skip", "raise" or "pass", as `SkipConfig.on_nonfinite`.
    """

    def __init__(self, mode: str) -> None:
        self._mode = mode
        self._warned: set[str] = set()
        self.in_a_row = 0

    def answer(self, view: str, loss: float, step: int, mean: float | None, n_views: int) -> Decision:
        """Decide on a loss that is not finite.

        Raises:
            BrokenTrainingError: mode is "raise", or every view of an epoch (at least 10 losses) in a row was
                non-finite.
        """
        known = "no finite loss before" if mean is None else f"mean of its finite losses {mean:.4g}"
        what = f"Loss is {loss} in iteration {step} on view {view!r} ({known})"
        self.in_a_row += 1
        if self._mode == "raise":
            raise BrokenTrainingError(f"{what}: it came out of the trainer so; check that image and camera.")
        if self.in_a_row >= max(MIN_IN_A_ROW, n_views):
            raise BrokenTrainingError(
                f"{what}, like {self.in_a_row - 1} losses before it: the model is lost; "
                "go back to a checkpoint and lower the learning rates."
            )
        if view not in self._warned:
            self._warned.add(view)
            then = "its backward is skipped" if self._mode == "skip" else "its backward runs all the same"
            caution(f"{what}; {then}.")
        return decision.NON_FINITE if self._mode == "skip" else decision.NON_FINITE_PASSED
