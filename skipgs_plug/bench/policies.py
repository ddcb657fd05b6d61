"""What is compared: the gate in three settings, an ungated run, and the controls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from skipgs_plug.trainer.errors import InputError


@dataclass(frozen=True)
class PolicySpec:
    """One row of the comparison.

    Attributes:
        meaning: one line for people.
        needs: policies of the same seed that must have run before, because it copies their rate or time.
        gate_settings: fields of SkipConfig that differ from the default; None for a run without SkipPolicy.
    """

    name: str
    meaning: str
    needs: tuple[str, ...] = ()
    gate_settings: dict[str, Any] | None = field(default=None)


POLICIES = {
    spec.name: spec
    for spec in (
        PolicySpec("ungated", "every backward runs"),
        PolicySpec("gate", "the paper's gate, default settings", gate_settings={}),
        PolicySpec("gate-no-floor", "the gate without a floor", gate_settings={"min_bwd_ratio": 0.0}),
        PolicySpec("gate-accumulate", "the gate, gradients accumulated", gate_settings={"step_mode": "adaptive_norm"}),
        PolicySpec("random", "control: as many skips as the gate, drawn by chance", needs=("gate",)),
        PolicySpec("periodic", "control: as many skips as the gate, evenly spread", needs=("gate",)),
        PolicySpec(
            "shortened",
            "control: no skips, fewer iterations, schedule compressed to the gate's time",
            needs=("ungated", "gate"),
        ),
    )
}


def check_policies(names: Sequence[str]) -> None:
    """Raise InputError for a policy that does not exist, is given twice, or lacks one that it needs."""
    for name in names:
        if name not in POLICIES:
            raise InputError(f"There is no policy {name!r}; the policies are {', '.join(POLICIES)}.")
        if names.count(name) > 1:
            raise InputError(f"Policy {name!r} is given twice.")
        missing = [other for other in POLICIES[name].needs if other not in names]
        if missing:
            raise InputError(f"Policy {name!r} copies what {missing[0]!r} measured; add {missing[0]} to --policies.")


def running_order(names: Sequence[str], position: int) -> list[PolicySpec]:
    """Return the order for the seed at `position`: rotated, so that a machine that slows down hits all alike.

    Controls that copy a measured rate or time come after the policies they copy, rotated among themselves.
    """
    specs = [POLICIES[name] for name in names]
    free = [spec for spec in specs if not spec.needs]
    controls = [spec for spec in specs if spec.needs]
    return rotated(free, position) + rotated(controls, position)


def rotated(specs: list[PolicySpec], by: int) -> list[PolicySpec]:
    shift = by % len(specs) if specs else 0
    return specs[shift:] + specs[:shift]
