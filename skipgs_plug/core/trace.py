"""Optional record of every gated decision."""

from __future__ import annotations

from typing import NamedTuple


class TraceRow(NamedTuple):
    """One gated decision.

    Attributes:
        step: Number of the iteration.
        view: Key of the view.
        loss: Value that was decided by.
        mean: Running mean of the view before this loss; None for a new view.
        reason: Reason; see `Decision`.
        skip: Whether the backward pass was skipped.
    """

    step: int
    view: str
    loss: float
    mean: float | None
    reason: str
    skip: bool
