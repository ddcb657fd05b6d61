"""Facts about a trainer that a gate needs before the first iteration."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any, Literal

from torch import Tensor


@dataclass(frozen=True)
class Densification:
    """How to recognise a trainer's densification events, and how many iterations they need before them.

    Args:
        marks: Names that identify the condition of densification among the loop's conditions on its number, such as
            `densification_interval`.
        numbers: For a strategy object that decides by itself: returns the iterations of a range that have an event.
        needs: Requirement for an event to be kept; events that do not meet it are left out. "visits": enough iterations
            ran since the last event for a mean over the visits of each Gaussian; a view that shows fewer Gaussians
            needs more, at most as many as in the trainer's own schedule. "iterations": as many iterations ran as in the
            trainer's own schedule; this suits thresholds on counts of visits. "nothing": every event is kept; this
            suits growth by a budget or by a constant share per event.
        resets: Whether opacities are reset now and then, so that few iterations run between two resets, or it is not
            known. Without resets, longer steps are tolerated in schedules of any length (3DGS-MCMC).
        reset_marks: Names that identify the condition of an opacity reset, as `marks` do for densification.
        reset_numbers: Returns the iterations of a range that reset opacities, as `numbers` does for densification.
        clears_moments: Whether every event clears Adam's moments of opacities, but not its count of steps. Adam's steps
            are several times as long after that, which lets opacities recover from resets, but only with the trainer's
            beta2. Opacities keep it then.
    """

    marks: tuple[str, ...] = ()
    numbers: Callable[[range], Iterable[int]] | None = None
    needs: Literal["visits", "iterations", "nothing"] = "visits"
    resets: bool = True
    reset_marks: tuple[str, ...] = ()
    reset_numbers: Callable[[range], Iterable[int]] | None = None
    clears_moments: bool = False


@dataclass(frozen=True)
class TrainerInfo:
    """Facts that an adapter passes to `Hooks.ready`. Every field but the first is optional.

    Args:
        start_iter: First iteration after densification, counted as the trainer counts; None if the trainer does not
            densify. It is used if the settings have no `start_iter`.
        settled_iter: First iteration after the last change of the model that is known beforehand, such as a prune
            after densification; None without one. If iterations are left out, refinement begins there, but not before
            `start_iter`: its steps shrink to zero once, and a model that is pruned afterwards has few steps to recover.
        view_names: Keys of all training views, checked for uniqueness.
        epoch: Number of iterations in which every view comes up once. None if each iteration shows one of
            `view_names`, so that an epoch has as many iterations as views.
        max_steps: Last iteration. A gate that starts after it gives a warning.
        world_size: Number of processes, if the trainer knows better than WORLD_SIZE.
        gradients_read_until: Until this iteration, code other than the optimizers, such as densification, reads
            gradients. A gate that the user starts earlier is refused.
        accumulates: Optimizers step on gradients that are accumulated over a fixed number of iterations. The number
            of steps does not change when iterations are left out. Each step has fewer gradients then, so steps of
            refinement are longer by the root of their share only, and shrink. With `share`, densification runs whole,
            since few steps follow it.
        steps_each: The trainer's own schedule accumulates, but the adapter makes refinement step as densification
            does, if iterations are left out and steps are longer. With `share`, densification runs
            whole all the same: the trainer's own run takes nearly all of its steps there.
        densification: How to find the densification events, so that fewer iterations can run before densification
            ends; None if all of them must run.
        photographs: Returns some training photographs [3, H, W] with values in [0, 1], if the adapter shows views at
            half their size while `Hooks.at_half_size`; None if it cannot.
        slow_positions: Whether the trainer may lower the learning rate of positions too slowly for its schedule.
        positions_rate: First learning rate of positions then; 0 if it is not known.
        random_points: Whether the scene begins with random points. If the trainer does not say, None: they are
            recognised by opacities that fall, unless a regulariser lowers them all (MCMC).
        defaults: Settings that suit this trainer. They are used where the user gave no value.
    """

    start_iter: int | None
    _: KW_ONLY
    settled_iter: int | None = None
    view_names: Iterable[str] | None = None
    epoch: int | None = None
    max_steps: int | None = None
    world_size: int | None = None
    gradients_read_until: int | None = None
    accumulates: bool = False
    steps_each: bool = False
    densification: Densification | None = None
    photographs: Callable[[], Iterable[Tensor]] | None = None
    slow_positions: bool = False
    positions_rate: float = 0.0
    random_points: bool | None = None
    defaults: Mapping[str, Any] = dataclasses.field(default_factory=dict)
