"""Optional record of every gated decision."""

from __future__ import annotations

from typing import NamedTuple


class TraceRow(NamedTuple):
    """One gated decision.

    Attributes:
        step: iteration.
        view: view key.
        loss: loss that was decided on.
        mean: The view's mean before this loss; None for a new view.
        reason: as in `Decision`.
        skip: True when the backward was skipped.
    """

    step: int
    view: str
    loss: float
    mean: float | None
    reason: str
    skip: bool
