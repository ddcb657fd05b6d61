"""Facts about a trainer that a gate needs before the first iteration."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Densification:
    """How a trainer's densification events are told from other iterations, and what they need behind them.

    Args:
        marks: Names in a condition of the loop on its number that make it the condition of densification, such as
            `densification_interval`.
        numbers: Gives the iterations with an event, of a range of them, where a strategy object decides by itself.
        needs: What must stand behind an event that is kept. "visits": enough visits of each Gaussian for a mean over
            them, or as many iterations as in the trainer's own schedule; events with less behind them are left out.
            "iterations": as many iterations as in the trainer's own schedule, for thresholds on counts of visits.
            "nothing": every event is kept, for growth by a budget or by a constant share per event.
    """

    marks: tuple[str, ...] = ()
    numbers: Callable[[range], Iterable[int]] | None = None
    needs: Literal["visits", "iterations", "nothing"] = "visits"


@dataclass(frozen=True)
class TrainerFacts:
    """What an adapter tells through `Hooks.ready`; everything but the first may stay unknown.

    Args:
        start_iter: First iteration after densification, in the trainer's counting; None when it has no
            densification to end. Used when the settings give none.
        view_names: Keys of all training views, checked for uniqueness.
        epoch: Number of iterations in which every view comes up once; None if an iteration shows one of `view_names`.
        max_steps: Last iteration; a gate that starts after it is worth a warning.
        world_size: Number of processes, when the trainer knows better than WORLD_SIZE.
        gradients_read_until: Before this iteration more than the optimizers reads gradients, densification
            say, so that a gate which the user starts earlier is refused.
        accumulates: Optimizers step every so many iterations on what gathered in between, however many of
            these ran: nothing is to be made up for.
        densification: Its events, for a growing phase with fewer iterations; None if growth must run whole.
        defaults: Settings that suit this trainer, used where the user gave none.
    """

    start_iter: int | None
    _: KW_ONLY
    view_names: Iterable[str] | None = None
    epoch: int | None = None
    max_steps: int | None = None
    world_size: int | None = None
    gradients_read_until: int | None = None
    accumulates: bool = False
    densification: Densification | None = None
    defaults: Mapping[str, Any] = dataclasses.field(default_factory=dict)
