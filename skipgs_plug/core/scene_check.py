"""Check whether a loaded state belongs to the scene that is trained: by its views, then by the first losses."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from skipgs_plug.core.errors import GateStateError

# Number of losses after a resume that are compared with the means of their views. A few may be far off by chance, but
# not ten in a row.
CHECKED_LOSSES = 10
# Factor between a loss and the mean of its view from which the loss counts as far off. A mean lags behind the losses,
# but by less than this factor while training continues.
FAR = 2.0


def require_same_scene(saved: Iterable[Any], names: list[str] | None) -> None:
    """Refuse a state that knows other views than the training views.

    Args:
        saved: Keys of the views in the state.
        names: Keys of all training views; None if they are unknown, and nothing is refused.

    Raises:
        SkipGSError: A view of the state is not a training view.
    """
    if names is None:
        return
    unknown = sorted({str(view) for view in saved} - set(names))
    if unknown:
        raise GateStateError(
            f"The gate state belongs to another scene: it knows view {unknown[0]!r}, which is not among "
            f"the {len(names)} training views; start the gate afresh."
        )


class SceneCheck:
    """Refuses a state when each of the first ten losses after it is far from the mean of its view.

    Names of views do not distinguish scenes whose images are numbered alike. One loss near its mean, or a structural
    change, ends the check.
    """

    def __init__(self) -> None:
        self._left = 0

    @property
    def running(self) -> bool:
        """Whether losses are still judged."""
        return self._left > 0

    def start(self) -> None:
        """Begin the check, because a state was loaded."""
        self._left = CHECKED_LOSSES

    def stop(self) -> None:
        """End the check, because a structural change makes losses jump."""
        self._left = 0

    def see(self, loss: float, mean: float | None, step: int) -> None:
        """Judge one loss while the check runs. A loss of a view without a mean does not count.

        Raises:
            SkipGSError: This is the tenth loss, and all ten were far off.
        """
        if mean is None or not self.running:
            return
        if mean <= 0.0 or mean / FAR <= loss <= mean * FAR:
            self.stop()
            return
        self._left -= 1
        if self._left == 0:
            raise GateStateError(
                f"The gate state belongs to another scene: up to iteration {step} each of {CHECKED_LOSSES} losses was "
                f"more than twice, or less than half, the mean of its view (last {loss:.4g}, mean {mean:.4g}); "
                "start the gate afresh."
            )
