"""Choose the pace that the settings of a gate ask for."""

from __future__ import annotations

from collections.abc import Callable

from skipgs_plug.core.caution import caution
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.pace.base import Pace
from skipgs_plug.core.pace.compensated import Compensated
from skipgs_plug.core.pace.phased import Phased
from skipgs_plug.core.pace.rates import ScaledRates
from skipgs_plug.core.release import Release

OF_PAPERS_GATE = ("threshold", "warmup", "min_bwd_ratio")  # settings that decide on nothing if a share is given


def pace_of(config: SkipConfig, rates: ScaledRates, go_on: Callable[[int], None], release: Release) -> Pace:
    """Return the pace for these settings; warn of those that have no effect beside a share.

    Args:
        config: Settings that the user gave.
        rates: Scales learning rates.
        go_on: Receives the first iteration of a resumed run, and loads the state of its checkpoint, if there is one.
        release: Receives errors, and raises them or releases the gate.
    """
    if config.leaves_out:
        usual = SkipConfig()
        idle = [name for name in OF_PAPERS_GATE if getattr(config, name) != getattr(usual, name)]
        if idle:
            listed = ", ".join(idle)
            caution(f"Leave out {listed}: only the paper's gate uses such settings, share and refine_share do not.", 5)
        return Phased(config, rates, go_on, release)
    return Compensated(config, rates) if config.compensates else Pace()
