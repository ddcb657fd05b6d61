"""What a gate must know of a trainer before its first iteration."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any


@dataclass(frozen=True)
class TrainerFacts:
    """What an adapter tells through `Hooks.ready`; everything but the first may stay unknown.

    Args:
        start_iter: First iteration after densification, in the trainer's counting; None when it has no
            densification to end. Used when the settings give none.
        view_names: Keys of all training views, checked for uniqueness.
        max_steps: Last iteration; a gate that starts after it is worth a warning.
        world_size: Number of processes, when the trainer knows better than WORLD_SIZE.
        gradients_read_until: Before this iteration more than the optimizers reads gradients, densification
            say, so that a gate which the user starts earlier is refused.
        accumulates: Optimizers step every so many iterations on what gathered in between, however many of
            these ran: nothing is to be made up for.
        defaults: Settings that suit this trainer, used where the user gave none.
    """

    start_iter: int | None
    _: KW_ONLY
    view_names: Iterable[str] | None = None
    max_steps: int | None = None
    world_size: int | None = None
    gradients_read_until: int | None = None
    accumulates: bool = False
    defaults: Mapping[str, Any] = dataclasses.field(default_factory=dict)
