"""The two phases of a run, growing and refining: iterations that ran or were left out, and estimated times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from skipgs_plug.report.blocks import Block, Table, Text

ROWS = (
    "iterations of the schedule",
    "run",
    "left out",
    "left out, %",
    "densification events run",
    "densification events left out",
    "steps longer by",
    "Gaussians at the end",
    "training, s",
    "without leaving out, s (estimate)",
)
ESTIMATE = (
    "The estimate takes an iteration that was left out to cost the mean of those of its phase that ran, which includes "
    "densification. It was not measured: a run without may end with another number of Gaussians."
)


@dataclass(frozen=True)
class Phase:
    """One phase. A field is None if the run does not record it.

    Attributes:
        run: iterations that ran.
        left_out: whole iterations that did not.
        seconds: of training.
        gaussians: at its end.
        rate_factor: by which steps were longer.
    """

    run: int
    left_out: int
    seconds: float
    gaussians: int | None = None
    events_run: int | None = None
    events_left_out: int | None = None
    rate_factor: float | None = None

    @property
    def iterations(self) -> int:
        """Of the schedule."""
        return self.run + self.left_out

    @property
    def without(self) -> float | None:
        """Estimated seconds that all its iterations would have taken; None if no iteration ran."""
        return self.seconds * self.iterations / self.run if self.run else None if self.left_out else 0.0


def phases(gate: Mapping[str, Any], curve: Mapping[str, Sequence[float]]) -> tuple[Phase, Phase]:
    """Return the growing and the refining phase.

    Args:
        gate: content of skipgs.json, of a gate that leaves out whole iterations.
        curve: columns of the course of training; may be empty.
    """
    growing = gate.get("growing") or {}
    end = gate["settings"].get("start_iter") or 0
    counts = list(zip(curve.get("step", ()), curve.get("num_GS", ()), strict=True))
    grown = [int(count) for step, count in counts if step < end]
    first = Phase(
        run=growing.get("iterations_run", gate["iterations"] - gate["gated_iterations"]),
        left_out=growing.get("iterations_skipped", 0),
        seconds=gate["t_total"] - gate["t_post"],
        gaussians=grown[-1] if grown else None,
        events_run=growing.get("events_run"),
        events_left_out=growing.get("events_skipped"),
        rate_factor=growing.get("rate_factor"),
    )
    last = Phase(
        run=gate["iterations_run"],
        left_out=gate["iterations_skipped"],
        seconds=gate["t_post"],
        gaussians=int(counts[-1][1]) if counts else None,
    )
    return first, last


def phase_blocks(gate: Mapping[str, Any], curve: Mapping[str, Sequence[float]]) -> list[Block]:
    """Return the table of both phases and of the whole run, and how the estimate was made."""
    growing, refining = phases(gate, curve)
    whole = Phase(
        growing.run + refining.run,
        growing.left_out + refining.left_out,
        growing.seconds + refining.seconds,
        refining.gaussians,
        growing.events_run,
        growing.events_left_out,
    )
    estimates = growing.without, refining.without
    total = None if None in estimates else sum(value for value in estimates if value is not None)
    columns = [_column(growing, growing.without), _column(refining, refining.without), _column(whole, total)]
    table = Table(
        "The two phases of the run",
        ("", "growing", "refining", "whole run"),
        [[name, *cells] for name, *cells in zip(ROWS, *columns, strict=True)],
    )
    return [table, Text([ESTIMATE])]


def _column(phase: Phase, without: float | None) -> list[str]:
    values: tuple[tuple[float | None, str], ...] = (
        (phase.iterations, ","),
        (phase.run, ","),
        (phase.left_out, ","),
        (100 * phase.left_out / phase.iterations if phase.iterations else None, ".1f"),
        (phase.events_run, ","),
        (phase.events_left_out, ","),
        (phase.rate_factor, ".1f"),
        (phase.gaussians, ","),
        (phase.seconds, ".1f"),
        (without, ".0f"),
    )
    return ["-" if value is None else format(value, form) for value, form in values]
