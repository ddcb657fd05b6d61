"""Facts about a trainer that a gate needs before the first iteration."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Densification:
    """How to recognise a trainer's densification events, and how many iterations they need before them.

    Args:
        marks: Names that identify the condition of densification among the loop's conditions on its number, such as
            `densification_interval`.
        numbers: Returns the iterations with an event out of a range, if a strategy object decides by itself.
        needs: Requirement for an event to be kept. "visits": enough visits of each Gaussian before it for a mean over
            them, or as many iterations as in the trainer's own schedule; other events are left out. "iterations": as
            many iterations as in the trainer's own schedule, for thresholds on counts of visits. "nothing": every
            event is kept, for growth by a budget or by a constant share per event.
    """

    marks: tuple[str, ...] = ()
    numbers: Callable[[range], Iterable[int]] | None = None
    needs: Literal["visits", "iterations", "nothing"] = "visits"


@dataclass(frozen=True)
class TrainerInfo:
    """Facts that an adapter passes to `Hooks.ready`. All but the first may stay unknown.

    Args:
        start_iter: First iteration after densification, counted like the trainer does; None if it does not densify.
            It is used if the settings do not give one.
        view_names: Keys of all training views, checked for uniqueness.
        epoch: Number of iterations in which every view comes up once; None if an iteration shows one of `view_names`.
        max_steps: Last iteration. A gate that starts after it gives a warning.
        world_size: Number of processes, if the trainer knows better than WORLD_SIZE.
        gradients_read_until: Until this iteration, code other than the optimizers reads gradients, such as
            densification. A gate that the user starts earlier is refused.
        accumulates: Optimizers step on gradients that are accumulated over a fixed number of iterations. The number
            of steps does not change when iterations are left out, so steps are not made larger.
        densification: The densification events, for a growing phase with fewer iterations; None if that phase must
            run whole.
        defaults: Settings that suit this trainer. They are used where the user gave none.
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
