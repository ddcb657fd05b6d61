"""Structural changes (prune, opacity reset, optimizer rebuild) and the pause that follows them."""

from __future__ import annotations

MIN_PAUSE_ITERS = 500  # iterations of a pause, at least, so that a scene of few views has time to settle


class Pause:
    """The iterations after a structural change that all run a real backward and are not recorded.

    A change makes every loss jump. Means keep their values from before the jump, so that a view counts as
    recovered only when it really is. New views get no mean during a pause, so that no mean is seeded at the peak.

    Attributes:
        until: first iteration that is not paused any more.
        events: number of changes that caused or extended a pause.
    """

    __slots__ = ("_iters", "events", "until")

    def __init__(self, pause_iters: int | None = None) -> None:
        self._iters = pause_iters
        self.until = 0
        self.events = 0

    def extend(self, step: int, n_views: int) -> int:
        """Pause the iterations after `step`; return by how many iterations the pause grows."""
        iters = max(n_views, MIN_PAUSE_ITERS) if self._iters is None else self._iters
        begin = max(self.until, step + 1)
        end = step + 1 + iters
        if end <= begin:
            return 0
        self.until = end
        self.events += 1
        return end - begin
