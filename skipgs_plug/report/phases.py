"""Show the two phases of a run, growing and refining: iterations run and left out, and estimated times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from skipgs_plug.report.elements import Element, Table, Text

ROWS = (
    "iterations of the schedule",
    "iterations run",
    "iterations left out",
    "iterations left out, %",
    "densification events run",
    "densification events left out",
    "factor on step lengths",
    "photographs of half the size until iteration",
    "Gaussians at the end",
    "training, s",
    "training without left-out iterations, s (estimate)",
)
ESTIMATE = (
    "The estimate assumes that each left-out iteration would have cost the mean of the iterations of its phase that "
    "ran, densification included. It was not measured: without left-out iterations the run may end with another number "
    "of Gaussians. Iterations on photographs of half the size take less time, so the estimate is too low with them."
)


@dataclass(frozen=True)
class Phase:
    """One phase of a run. A field is None if the run did not record it.

    Attributes:
        run: Number of iterations that ran.
        left_out: Number of iterations that were left out as a whole.
        seconds: Training time of the phase in seconds.
        gaussians: Number of Gaussians at the end of the phase.
        events_run: Number of densification events that ran.
        events_left_out: Number of densification events that were left out.
        rate_factor: Factor by which optimizer steps were longer.
        half_size_until: Iteration before which photographs had half their size.
    """

    run: int
    left_out: int
    seconds: float
    gaussians: int | None = None
    events_run: int | None = None
    events_left_out: int | None = None
    rate_factor: float | None = None
    half_size_until: int | None = None

    @property
    def iterations(self) -> int:
        """Number of iterations of the phase in the schedule."""
        return self.run + self.left_out

    @property
    def without(self) -> float | None:
        """Estimated training time of the phase in seconds if all iterations had run; None if no iteration ran."""
        return self.seconds * self.iterations / self.run if self.run else None if self.left_out else 0.0


def phases(gate: Mapping[str, Any], curve: Mapping[str, Sequence[float]]) -> tuple[Phase, Phase]:
    """Return the growing and the refining phase.

    Args:
        gate: Content of the skipgs.json of a gate that leaves out whole iterations.
        curve: Columns of the training curve, see `RunSource`; may be empty.
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
        half_size_until=growing.get("half_size_until") or None,
    )
    last = Phase(
        run=gate["iterations_run"],
        left_out=gate["iterations_skipped"],
        seconds=gate["t_post"],
        gaussians=int(counts[-1][1]) if counts else None,
    )
    return first, last


def phase_elements(gate: Mapping[str, Any], curve: Mapping[str, Sequence[float]]) -> list[Element]:
    """Return a table of both phases and the whole run, and a text that explains the estimate."""
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
        (phase.half_size_until, ","),
        (phase.gaussians, ","),
        (phase.seconds, ".1f"),
        (without, ".0f"),
    )
    return ["-" if value is None else format(value, form) for value, form in values]
