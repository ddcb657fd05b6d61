"""The settings of the gate in a checkpoint: a run continues with the settings that it began with."""

from __future__ import annotations

from typing import Any

from skipgs_plug import SkipConfig, SkipGate
from skipgs_plug.trainer import InputError


class GateSettings:
    """Part of a trainer's checkpoints. Refuses to resume a checkpoint that was made with other settings.

    Args:
        gate: The gate of the run; None if it has no gate, or has none yet.
    """

    def __init__(self, gate: SkipGate | None) -> None:
        self.gate = gate

    def state_dict(self) -> dict[str, Any]:
        return {"settings": None if self.gate is None else self.gate.config.as_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Compare the settings with those of this run.

        Raises:
            InputError: The checkpoint was made with other settings. The message names the first difference.
        """
        before, now = state["settings"], self.state_dict()["settings"]
        if (before is None) != (now is None):
            raise InputError(
                "The run was begun without a gate; resume it without --gate and without gate settings."
                if before is None
                else "The run was begun with a gate; resume it with --gate or with the same gate settings."
            )
        # A run that is older than a setting ran with its default.
        before = SkipConfig().as_dict() | (before or {})
        for name, value in (now or {}).items():
            if before[name] != value:
                raise InputError(
                    f"The run was begun with gate.{name}={before[name]!r}, not {value!r}; resume it with that setting."
                )
