"""The answer of a policy: skip or run, and the reason."""

from __future__ import annotations

from typing import NamedTuple


class Decision(NamedTuple):
    """Answer of a policy for one view in one iteration.

    Attributes:
        skip: True if the backward pass is skipped.
        reason: Why: "warm-up", "new view", "deviation" (loss against the view's mean), "budget" (the floor forbids a
            skip), "pause", "non-finite", "inactive", "forced" (the adapter forbids a skip in this iteration),
            "other rank" (another process needs the backward pass), "full" (with a share, an iteration that is not
            left out runs whole), "watched" (the view is not trained on for a while) or "over" (refinement has ended).

    Examples:
        >>> from skipgs_plug import Decision
        >>> Decision(True, "deviation")
        Decision(skip=True, reason='deviation')
    """

    skip: bool
    reason: str


# One object per answer: a decision costs no allocation.
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
