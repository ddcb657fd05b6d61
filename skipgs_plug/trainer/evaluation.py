"""Metrics of rendered views against their photographs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from skipgs_plug.trainer import metrics
from skipgs_plug.trainer.image_store import one_by_one
from skipgs_plug.trainer.mask import leave_out
from skipgs_plug.trainer.scene import View


def evaluate(
    views: Sequence[View],
    wanted: Sequence[metrics.Metric],
    render: Callable[[View], Tensor],
    target: Callable[[View], Tensor],
    keep: Callable[[int, View, Tensor], object] | None = None,
) -> tuple[dict[str, float], list[dict[str, Any]]]:
    """Return the mean of each metric by name, and the metrics of each view with its name.

    Args:
        views: The views, at least one.
        wanted: The metrics.
        render: Returns the image [H, W, 3] of a view, in [0, 1].
        target: Returns the photograph [H, W, 3] uint8 of a view, on the device of the image.
        keep: Called for each view with its number, the view and its image.
    """
    rows = []
    for i, view in enumerate(one_by_one(views)):
        rendered = render(view)
        if keep is not None:
            keep(i, view, rendered)
        image, photograph = leave_out(rendered, target(view).float() / 255.0, view.mask)
        rows.append(metrics.measure(wanted, image, photograph, view.mask))
    means = {key: sum(row[key] for row in rows) / len(rows) for key in rows[0]}
    return means, [{"view": view.name, **row} for view, row in zip(views, rows, strict=True)]
