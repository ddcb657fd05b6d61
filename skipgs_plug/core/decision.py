"""What a policy answers: skip or not, and why."""

from __future__ import annotations

from typing import NamedTuple


class Decision(NamedTuple):
    """Answer of a policy for one view in one iteration.

    Attributes:
        skip: True when the backward is to be left out.
        reason: what decided: "warm-up", "new view", "deviation" (loss against the view's mean), "budget"
            (a skip that the floor forbids), "pause", "non-finite", "inactive", "forced" (the adapter rules
            skipping out in this iteration), "other rank" (a process of the group needs the backward), "full" (an
            iteration that was not left out runs whole), "watched" (the view is not trained on for a while) or
            "over" (refinement has ended).
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
