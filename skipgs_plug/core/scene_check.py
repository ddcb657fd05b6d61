"""Whether a loaded state can be of the scene that is trained, judged by the first losses after it."""

from __future__ import annotations

from skipgs_plug.core.errors import SkipGSError

CHECKED_LOSSES = 10  # first losses after a resume that are compared with the means of their views
# Factor between a loss and the mean of its view above which the scenes differ. A mean lags behind its loss,
# but by less than that when training continues.
FAR = 2.0


class SceneCheck:
    """Refuses a state when each of the first ten losses after it is far from the mean of its view.

    Names of views do not tell scenes apart that count their images alike. One loss near its mean, or a
    structural change, ends the check.
    """

    def __init__(self) -> None:
        self._left = 0

    @property
    def running(self) -> bool:
        """Whether losses are still judged."""
        return self._left > 0

    def start(self) -> None:
        """A state was loaded."""
        self._left = CHECKED_LOSSES

    def stop(self) -> None:
        """Losses jump for a reason."""
        self._left = 0

    def see(self, loss: float, mean: float | None, step: int) -> None:
        """Judge one loss, while the check runs; a view without a mean says nothing.

        Raises:
            SkipGSError: It was the tenth, and all were far off.
        """
        if mean is None or not self.running:
            return
        if mean <= 0.0 or mean / FAR <= loss <= mean * FAR:
            self.stop()
            return
        self._left -= 1
        if self._left == 0:
            raise SkipGSError(
                f"The gate state belongs to another scene: up to iteration {step} each of {CHECKED_LOSSES} losses was "
                f"more than twice, or less than half, the mean of its view (last {loss:.4g}, mean {mean:.4g}); "
                "start the gate afresh."
            )
