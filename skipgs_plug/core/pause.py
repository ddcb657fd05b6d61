"""Structural changes (prune, opacity reset, optimizer rebuild) and the pause that follows them."""

from __future__ import annotations

# Least number of iterations of a pause, so that losses settle in scenes of few views too. In other scenes a pause has
# one iteration per view.
MIN_PAUSE_ITERS = 500


class Pause:
    """The iterations after a structural change. All of them run a real backward pass, and none is recorded.

    A change makes every loss jump. Means keep their values from before the jump, so that a view counts as recovered
    only when its loss is back. New views get no mean during a pause, so that no mean is seeded at the peak.

    Attributes:
        until: First iteration after the pause.
        changes: Number of changes that caused or extended a pause.
    """

    __slots__ = ("_iters", "changes", "until")

    def __init__(self, pause_iters: int | None = None) -> None:
        self._iters = pause_iters
        self.until = 0
        self.changes = 0

    def extend(self, step: int, n_views: int) -> int:
        """Pause after a structural change; return the number of iterations that this adds to the pause.

        Args:
            step: Iteration of the change.
            n_views: Number of training views.
        """
        iters = max(n_views, MIN_PAUSE_ITERS) if self._iters is None else self._iters
        begin = max(self.until, step + 1)
        end = step + 1 + iters
        if end <= begin:
            return 0
        self.until = end
        self.changes += 1
        return end - begin
