"""Errors of forecasts against whole runs on the scenes of the bench. `benchmarks/forecast.py` measures them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("errors.json")
QUANTITIES = ("seconds", "seconds_auto", "iterations_auto", "gaussians", "memory")


def measured_errors() -> dict[str, Any]:
    """Return `provenance`, and `rows`: `scene`, `max_steps`, `how`, `part`, `quantity`, `expected` and `measured`.

    `part` is the share of the run's iterations that were trained for the forecast.
    """
    return json.loads(FILE.read_text("utf-8"))  # type: ignore[no-any-return]


def error(row: Mapping[str, Any]) -> float:
    """Return the relative error of a row: 0.1 if the expected value was 10 % above the measured one."""
    return float(row["expected"] / row["measured"] - 1.0)


def spread(rows: Iterable[Mapping[str, Any]], quantity: str) -> tuple[float, float, int] | None:
    """Return the lowest and the highest error of a quantity, and its number of rows; None if it has no rows."""
    errors = [error(row) for row in rows if row["quantity"] == quantity]
    return (min(errors), max(errors), len(errors)) if errors else None
