"""Policies of the whole run, from its first iteration on, and the controls.

The name of a policy is the settings that a user would give to `SkipGate`, as in `policies`. A new policy is one entry
of WHOLE_POLICIES: a name, a line of explanation, the policies that it copies from, and the function that runs it.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

from skipgs_plug import SkipGate
from skipgs_plug.bench.policies import REFERENCE, BenchPolicy, Earlier, gate_with, number_after, table_of
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.bench.sampling import periodic_numbers, random_numbers
from skipgs_plug.bench.whole import Maker, as_many_gaussians, planned, shortened, whole_run
from skipgs_plug.core.pace.rates import path_factor
from skipgs_plug.trainer import Trainer

COPIED = "share=auto"  # controls copy its share, time or number of Gaussians
Run = Callable[[Maker, Earlier, RunRecord], Generator[None, None, None]]


@dataclass(frozen=True)
class WholeBenchPolicy(BenchPolicy):
    """One row of the comparison of whole runs.

    Attributes:
        run: Trains with trainers that it makes, fills the record, and yields now and then, for other policies.
    """

    run: Run = None  # type: ignore[assignment]


def own(make: Maker, earlier: Earlier, record: RunRecord) -> Generator[None, None, None]:
    """Train without a gate."""
    yield from whole_run(make(), None, record, make)


def gated(**settings: object) -> Run:
    """Return a function that trains with a gate; `settings` are arguments of SkipGate."""

    def run(make: Maker, earlier: Earlier, record: RunRecord) -> Generator[None, None, None]:
        trainer = make()
        yield from whole_run(trainer, gate_with(**settings)(trainer, earlier), record, make)

    return run


def larger_steps(trainer: Trainer, earlier: Earlier) -> SkipGate:
    """Attach rate factors with which this short refinement covers the same distance as the own run's."""
    full = earlier[REFERENCE].iterations
    share = min(1.0, trainer.max_steps / full)
    steps = trainer.max_steps - trainer.refine_stop_iter
    peak = path_factor(share, 0.0, visible=earlier[COPIED].gaussians_shown, steps=steps)
    gate = gate_with(refine_share=1.0, rate_peak=peak)(trainer, earlier)
    assert gate is not None
    return gate


WHOLE_POLICIES = table_of(
    WholeBenchPolicy(REFERENCE, "the trainer's own run: every iteration runs as it is", run=own),
    WholeBenchPolicy("gate", "the paper's gate, default settings, after densification", run=gated()),
    WholeBenchPolicy(
        "refine_share=auto",
        "densification as it is, then as many iterations as the scene needs, with larger, shrinking steps",
        run=gated(refine_share="auto"),
    ),
    WholeBenchPolicy(COPIED, "as many iterations as the scene needs in the whole run", run=gated(share="auto")),
    WholeBenchPolicy("share=0.4", "40 % of the iterations of the whole run", run=gated(share=0.4)),
    WholeBenchPolicy(
        f"{COPIED},no-compensate",
        f"control: {COPIED} with steps as they are",
        run=gated(share="auto", compensate=False),
    ),
    WholeBenchPolicy(
        "shortened",
        f"control: a schedule with all its milestones compressed to the time of {COPIED}",
        (REFERENCE, COPIED),
        shortened(COPIED),
    ),
    WholeBenchPolicy(
        "shortened,compensate",
        "control: the same with larger, shrinking steps in refinement",
        (REFERENCE, COPIED),
        shortened(COPIED, larger_steps),
    ),
    WholeBenchPolicy(
        "random",
        f"control: as many iterations as {COPIED} in each phase, drawn by chance, with all events, steps as they are",
        (COPIED,),
        planned(COPIED, random_numbers),
    ),
    WholeBenchPolicy(
        "periodic",
        f"control: as many iterations as {COPIED} in each phase, evenly spread, with all events, steps as they are",
        (COPIED,),
        planned(COPIED, periodic_numbers),
    ),
    WholeBenchPolicy(
        "own,grow_grad2d",
        f"control: the own run with grow_grad2d set so that it ends with as many Gaussians as {COPIED}",
        (REFERENCE, COPIED),
        as_many_gaussians(COPIED),
    ),
)


def whole_policy(name: str) -> WholeBenchPolicy | None:
    """Return the policy with this name; None if it does not exist. Shares are numbers in (0, 1]."""
    if name in WHOLE_POLICIES:
        return WHOLE_POLICIES[name]
    share, refined = number_after("share", name), number_after("refine_share", name)
    if share is not None:
        return WholeBenchPolicy(name, f"{100 * share:g} % of the iterations of the whole run", run=gated(share=share))
    if refined is not None:
        meaning = f"densification as it is, then {100 * refined:g} % of the iterations, with larger, shrinking steps"
        return WholeBenchPolicy(name, meaning, run=gated(refine_share=refined))
    return None
