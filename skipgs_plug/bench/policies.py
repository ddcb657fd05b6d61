"""What is compared: an ungated run, the gate in three settings, and the controls.

A new policy is one entry of POLICIES. It makes its gate and its number of iterations itself, from a trainer that
stands at the end of densification and from the finished runs of the same seed, of which it may copy rate or time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from skipgs_plug import SkipGate
from skipgs_plug.bench.controls import PlannedSkipping, periodic_skipping, random_skipping
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.core.pace.rates import path_factor
from skipgs_plug.trainer import Trainer
from skipgs_plug.trainer.errors import InputError

REFERENCE = "ungated"  # what the others are compared with
SHARE = 0.4  # of the iterations, where whole ones are left out
Earlier = Mapping[str, RunRecord]
GateMaker = Callable[[Trainer, Earlier], SkipGate | None]
Plan = Callable[[int, int, int, int], PlannedSkipping]  # of first, end, number of skips, seed


def gate_with(**settings: Any) -> GateMaker:
    """Return what attaches a gate: `settings` are arguments of SkipGate that differ from the default."""
    # A loss that is not finite ends the run: a bench must not average over it.
    return lambda trainer, earlier: SkipGate(trainer, record_trace=True, on_nonfinite="raise", **settings)


def planned_as(name: str, plan: Plan, **settings: Any) -> GateMaker:
    """Return what attaches a control: as many skips as policy `name`, after the same warm-up; `settings` as above."""

    def make(trainer: Trainer, earlier: Earlier) -> SkipGate:
        copied = earlier[name]
        first, end = trainer.refine_stop_iter + copied.warm_up, trainer.max_steps
        policy = plan(first, end, copied.skips, trainer.config.seed)
        return gate_with(policy=policy, **settings)(trainer, earlier)  # type: ignore[return-value]

    return make


def as_long_as(name: str) -> Callable[[Trainer, Earlier], int]:
    """Return what tells how many ungated iterations take as long as policy `name` did."""

    def iterations(trainer: Trainer, earlier: Earlier) -> int:
        full = all_iterations(trainer, earlier)
        return max(1, round(full * share_of_time(name, earlier)))

    return iterations


def stepping_as(name: str, share: float) -> GateMaker:
    """Return what runs every iteration, with the factors on rates of policy `name`, which runs `share` of them."""

    def make(trainer: Trainer, earlier: Earlier) -> SkipGate:
        peak = path_factor(share, 0.0, shown=earlier[name].gaussians_shown)
        return gate_with(refine_share=1.0, rate_peak=peak)(trainer, earlier)  # type: ignore[return-value]

    return make


def thinned_as_long_as(name: str) -> GateMaker:
    """Return what leaves out whole iterations, so many that the rest takes as long as policy `name` did."""

    def make(trainer: Trainer, earlier: Earlier) -> SkipGate:
        return gate_with(refine_share=share_of_time(name, earlier))(trainer, earlier)  # type: ignore[return-value]

    return make


def share_of_time(name: str, earlier: Earlier) -> float:
    """Return the refinement time of policy `name`, as a share of ungated's, at most 1."""
    return min(1.0, earlier[name].t_post / earlier[REFERENCE].t_post)


def no_gate(trainer: Trainer, earlier: Earlier) -> None:
    """Attach nothing."""


def all_iterations(trainer: Trainer, earlier: Earlier) -> int:
    """Return the number of iterations from the end of densification to the end of the schedule."""
    return trainer.max_steps - trainer.refine_stop_iter


@dataclass(frozen=True)
class PolicySpec:
    """One row of the comparison.

    Attributes:
        name: as given to --policies.
        meaning: one line for people.
        gate: attaches the gate of this policy to a trainer and returns it; None for a run without.
        iterations: number of iterations; fewer than are left run through the same schedule, compressed.
        needs: policies of the same seed that must have run before, because it copies their rate or time.
    """

    name: str
    meaning: str
    gate: GateMaker = no_gate
    iterations: Callable[[Trainer, Earlier], int] = all_iterations
    needs: tuple[str, ...] = ()


POLICIES = {
    spec.name: spec
    for spec in (
        PolicySpec(REFERENCE, "every backward runs"),
        PolicySpec("gate", "the paper's gate, default settings", gate_with()),
        PolicySpec("gate-no-floor", "the gate without a floor", gate_with(min_bwd_ratio=0.0)),
        PolicySpec(
            "random",
            "control: as many skips as the gate, drawn by chance",
            planned_as("gate", random_skipping),
            needs=("gate",),
        ),
        PolicySpec(
            "periodic",
            "control: as many skips as the gate, evenly spread",
            planned_as("gate", lambda first, end, n_skips, seed: periodic_skipping(first, end, n_skips)),
            needs=("gate",),
        ),
        PolicySpec(
            "shortened",
            "control: no skips, fewer iterations, schedule compressed to the gate's time",
            iterations=as_long_as("gate"),
            needs=(REFERENCE, "gate"),
        ),
        PolicySpec(
            "ungated-larger",
            "every iteration runs, with the larger, shrinking steps of thinned",
            stepping_as("thinned", SHARE),
            needs=("thinned",),
        ),
        PolicySpec(
            "thinned", "40 % of the iterations run, with larger, shrinking steps", gate_with(refine_share=SHARE)
        ),
        PolicySpec("thinned-quarter", "25 % of the iterations run, likewise", gate_with(refine_share=0.25)),
        PolicySpec("thinned-fifth", "20 % of the iterations run, likewise", gate_with(refine_share=0.2)),
        PolicySpec("automatic", "as many iterations as the scene needs, likewise", gate_with(refine_share="auto")),
        PolicySpec(
            "thinned-plain",
            "control: 40 % of the iterations run, steps as they are",
            gate_with(refine_share=SHARE, compensate=False),
        ),
        PolicySpec("gate-larger", "the paper's gate, with larger, shrinking steps", gate_with(compensate=True)),
        PolicySpec(
            "random-larger",
            "control: random, with larger, shrinking steps",
            planned_as("gate", random_skipping, compensate=True),
            needs=("gate",),
        ),
        PolicySpec(
            "periodic-larger",
            "control: periodic, with larger, shrinking steps",
            planned_as(
                "gate", lambda first, end, n_skips, seed: periodic_skipping(first, end, n_skips), compensate=True
            ),
            needs=("gate",),
        ),
        PolicySpec(
            "shortened-larger",
            "control: iterations thinned to the gate's time, with larger, shrinking steps",
            thinned_as_long_as("gate"),
            needs=(REFERENCE, "gate"),
        ),
    )
}


def check_policies(names: Sequence[str]) -> None:
    """Raise InputError for no policy, one that does not exist, is given twice, or lacks one that it needs."""
    if not names:
        raise InputError(f"--policies names none; give some of {', '.join(POLICIES)}, or leave it out for all.")
    for name in names:
        if name not in POLICIES:
            raise InputError(f"There is no policy {name!r}; the policies are {', '.join(POLICIES)}.")
        if names.count(name) > 1:
            raise InputError(f"Policy {name!r} is given twice.")
        missing = [other for other in POLICIES[name].needs if other not in names]
        if missing:
            raise InputError(f"Policy {name!r} copies what {missing[0]!r} measured; add {missing[0]} to --policies.")


def rounds(names: Sequence[str], position: int) -> list[list[PolicySpec]]:
    """Return what may run in turns: policies that copy nothing, then those that copy from them, and so on.

    The order within a round is rotated by `position`, that of the seed.
    """
    waiting = [POLICIES[name] for name in names]
    done: set[str] = set()
    found = []
    while waiting:
        ready = [spec for spec in waiting if done.issuperset(spec.needs)]
        waiting = [spec for spec in waiting if spec not in ready]
        done.update(spec.name for spec in ready)
        shift = position % len(ready)
        found.append(ready[shift:] + ready[:shift])
    return found
