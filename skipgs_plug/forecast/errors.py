"""How far forecasts were from whole runs on the scenes of the bench; measured by `benchmarks/forecast.py`."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("errors.json")
QUANTITIES = ("seconds", "seconds_auto", "gaussians", "memory")


def measured_errors() -> dict[str, Any]:
    """Return what is stored: `provenance`, and `rows` with `scene max_steps quantity expected measured`."""
    return json.loads(FILE.read_text("utf-8"))  # type: ignore[no-any-return]


def error(row: Mapping[str, Any]) -> float:
    """Return by what share the expectation of a row was above the measurement."""
    return float(row["expected"] / row["measured"] - 1.0)


def spread(rows: Iterable[Mapping[str, Any]], quantity: str) -> tuple[float, float, int] | None:
    """Return the lowest and the highest error of a quantity and the number of its rows; None without any."""
    errors = [error(row) for row in rows if row["quantity"] == quantity]
    return (min(errors), max(errors), len(errors)) if errors else None
