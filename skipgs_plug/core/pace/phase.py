"""The interface of a phase of a run, and the phase in which every iteration runs with the trainer's own rates."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from torch import Tensor

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.trainer_info import Densification

# Reason of iterations that must run and that no condition of the loop names.
NAMED_FOR_TRAINER = "named for this trainer"


class PhasePlan(NamedTuple):
    """Facts about a phase that are known when the loop begins.

    Attributes:
        numbers: Iterations of the phase, from the first that can be left out.
        conditions: Iterations that conditions of the loop name, by condition.
        named: Further iterations of `numbers` that must run.
        last: Last iteration of the run.
        before: The phase before this one.
        views: Keys of all training views; None if unknown.
        epoch: Number of iterations in which every view comes up once; None if unknown.
        densification: How to recognise densification events; None if unknown.
        accumulates: Optimizers step on gradients that are accumulated over several iterations; see `TrainerInfo`.
        photographs: Returns some training photographs, if views can be shown at half their size; see `TrainerInfo`.
        slow_positions: Whether the learning rate of positions may fall too slowly; see `TrainerInfo`.
        positions_rate: First learning rate of positions then; 0 if it is not known.
        random_points: Whether the scene begins with random points; None if unknown. See `TrainerInfo`.
        steps_each: Optimizers would do so, but step in refinement as in densification; see `TrainerInfo`.
    """

    numbers: range
    conditions: Mapping[str, set[int]]
    named: set[int]
    last: int
    before: Phase
    views: list[str] | None
    epoch: int | None
    densification: Densification | None
    accumulates: bool
    photographs: Callable[[], Iterable[Tensor]] | None = None
    slow_positions: bool = False
    positions_rate: float = 0.0
    random_points: bool | None = None
    steps_each: bool = False

    def epoch_for(self, setting: str) -> int:
        """Return `epoch` for a setting that needs it.

        Raises:
            SkipGSError: It is unknown.
        """
        if self.epoch is not None:
            return self.epoch
        needed = f'{setting}="auto" must know the training views'
        raise SkipGSError(
            f"{needed}; give their names to gate.iterations() as views=, or a share.",
            in_script=f"{needed}, which this trainer does not tell; give a share, such as 0.2.",
        )


class Phase:
    """A phase in which every iteration runs, and learning rates do not change. Other phases derive from this one.

    `begin` is called when a training loop begins, and again after a state is loaded inside the loop. A run may have
    several loops, one after the other. Then `runs` is the one question about each iteration of the phase. It also sets
    the learning rates of an iteration that runs.

    Attributes:
        leaves_out: Whether iterations of the phase may be left out.
        share: Share of the iterations that runs, in (0, 1]; None if it is not known yet.
    """

    leaves_out: bool = False
    share: float | None = 1.0

    def numbers(self, number: int, end: int) -> range:
        """Return the iterations for which the phase must know whether they have to run.

        Args:
            number: First iteration of the phase that is still to come.
            end: Iteration at which the phase ends.
        """
        return range(0)

    def begin(self, plan: PhasePlan) -> bool:
        """Receive the facts that are known when a loop begins; return False if its part of the phase must run whole.

        Raises:
            SkipGSError: A fact that this phase needs is unknown.
        """
        return True

    def runs(self, number: int) -> bool:
        """Whether iteration `number` runs; called once for each number, in order."""
        return True

    def at_half_size(self, number: int) -> bool:
        """Return whether iteration `number` trains on a photograph of half the width and height."""
        return False

    def is_named(self, number: int) -> bool:
        """Return whether a condition of the loop, or the adapter, may name iteration `number`."""
        return True

    def require(self, number: int) -> None:
        """Make iteration `number` run. Call it for a need that shows only during the run."""

    def end(self) -> None:
        """Take note that the following phase begins."""

    def shortened(self, end: int) -> int:
        """Return the number of iterations from the first of the phase to `end`; 0 if none of them is left out."""
        return 0

    @property
    def opacity_rate(self) -> float:
        """Learning rate that opacities need to recover from their last reset, also in the following phase; else 0."""
        return 0.0

    @property
    def stretch(self) -> float:
        """Factor on the share of the iterations for Gaussians that were added, also in the following phase."""
        return 1.0

    def report(self) -> dict[str, Any] | None:
        """Return the entries of skipgs.json about this phase; None if it leaves out no iteration."""
        return None

    def state_dict(self) -> dict[str, Any] | None:
        """Return the state; None if nothing changes."""
        return None

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict()`; `begin` follows.

        Raises:
            SkipGSError: No run has such a state.
        """
