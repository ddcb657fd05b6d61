"""The answer of a policy: skip or run, and the reason."""

from __future__ import annotations

from typing import NamedTuple


class Decision(NamedTuple):
    """Answer of a policy for one view in one iteration.

    Attributes:
        skip: True if the backward pass is skipped.
        reason: One of "warm-up", "new view", "deviation" (the loss was compared with the view's mean), "budget" (the
            floor forbids a skip), "pause" (after a structural change), "non-finite" (the loss is NaN or infinite),
            "inactive" (the gate is off, or has not started), "forced" (the adapter forbids a skip in this iteration),
            "other rank" (another process needs the backward pass), "full" (with a share: the iteration is not left
            out, so it runs whole), "watched" (the view is temporarily not trained on) and "over" (refinement has
            ended).

    Examples:
        >>> from skipgs_plug import Decision
        >>> Decision(True, "deviation")
        Decision(skip=True, reason='deviation')
    """

    skip: bool
    reason: str


# Shared instances, so that a decision allocates no memory.
INACTIVE = Decision(False, "inactive")
WARM_UP = Decision(False, "warm-up")
NEW_VIEW = Decision(False, "new view")
AT_OR_BELOW_MEAN = Decision(True, "deviation")
ABOVE_MEAN = Decision(False, "deviation")
BUDGET = Decision(False, "budget")
PAUSE = Decision(False, "pause")
NON_FINITE = Decision(True, "non-finite")
NON_FINITE_PASSED = Decision(False, "non-finite")
FORCED = Decision(False, "forced")
OTHER_RANK = Decision(False, "other rank")
FULL = Decision(False, "full")
WATCHED = Decision(True, "watched")
OVER = Decision(True, "over")
