"""Policies of refinement after one densification: the trainer's own, the gate, fewer iterations, and controls.

The name of a policy is the settings that a user would give to `SkipGate`: `gate`, `refine_share=auto`, and further
settings after a comma. A new policy is one entry of POLICIES. It makes its gate and its number of iterations from a
trainer at the end of densification and from the finished runs of the same seed, whose rate or time it may copy.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from skipgs_plug import SkipGate
from skipgs_plug.bench.controls import PlannedSkipping, periodic_skipping, random_skipping
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.core.pace.rates import path_factor
from skipgs_plug.trainer import Trainer

REFERENCE = "own"  # policy that all others are compared with
COPIED = "refine_share=0.4"  # policy whose steps and iterations the controls copy
Earlier = Mapping[str, RunRecord]
GateMaker = Callable[[Trainer, Earlier], SkipGate | None]
Plan = Callable[[int, int, int, int], PlannedSkipping]  # arguments: first, end, number of skips, seed


def gate_with(**settings: Any) -> GateMaker:
    """Return a function that attaches a gate. `settings` are arguments of SkipGate."""
    # A loss that is not finite ends the run, since a bench must not average over it.
    return lambda trainer, earlier: SkipGate(trainer, record_trace=True, on_nonfinite="raise", **settings)


def planned_as(name: str, plan: Plan, **settings: Any) -> GateMaker:
    """Return a function that attaches a control with as many skips as policy `name`, after the same warm-up."""

    def make(trainer: Trainer, earlier: Earlier) -> SkipGate:
        copied = earlier[name]
        first, end = trainer.refine_stop_iter + copied.warm_up, trainer.max_steps
        policy = plan(first, end, copied.skips, trainer.config.seed)
        return gate_with(policy=policy, **settings)(trainer, earlier)  # type: ignore[return-value]

    return make


def as_long_as(name: str) -> Callable[[Trainer, Earlier], int]:
    """Return a function that computes how many iterations of the own run take as long as policy `name`."""

    def iterations(trainer: Trainer, earlier: Earlier) -> int:
        full = all_iterations(trainer, earlier)
        return max(1, round(full * share_of_time(name, earlier)))

    return iterations


def stepping_as(name: str) -> GateMaker:
    """Return a function that runs every iteration with the learning-rate factors of policy `name`."""

    def make(trainer: Trainer, earlier: Earlier) -> SkipGate:
        share = float(name.partition("=")[2])
        steps = share * all_iterations(trainer, earlier)
        peak = path_factor(share, 0.0, visible=earlier[name].gaussians_shown, steps=steps)
        return gate_with(refine_share=1.0, rate_peak=peak)(trainer, earlier)  # type: ignore[return-value]

    return make


def refine_share_as_long_as(name: str) -> GateMaker:
    """Return a function that leaves out iterations until the rest takes as long as policy `name`."""

    def make(trainer: Trainer, earlier: Earlier) -> SkipGate:
        return gate_with(refine_share=share_of_time(name, earlier))(trainer, earlier)  # type: ignore[return-value]

    return make


def share_of_time(name: str, earlier: Earlier) -> float:
    """Return the refinement time of policy `name`, as a share of the own run's, at most 1."""
    return min(1.0, earlier[name].t_post / earlier[REFERENCE].t_post)


def no_gate(trainer: Trainer, earlier: Earlier) -> None:
    """Attach no gate."""


def all_iterations(trainer: Trainer, earlier: Earlier) -> int:
    """Return the number of iterations from the end of densification to the end of the schedule."""
    return trainer.max_steps - trainer.refine_stop_iter


@dataclass(frozen=True)
class BenchPolicy:
    """One row of a comparison.

    Attributes:
        name: Name for --policies.
        meaning: One line that explains it.
        needs: Policies of the same seed that must run before it, because it copies their rate or time.
    """

    name: str
    meaning: str
    needs: tuple[str, ...] = ()


@dataclass(frozen=True)
class RefineBenchPolicy(BenchPolicy):
    """One row of the comparison of refinements.

    Attributes:
        gate: Attaches the gate of this policy to a trainer and returns it; None for a run without a gate.
        iterations: Returns the number of iterations. If it is smaller than the rest of the run, the schedule of the
            rest is compressed.
    """

    gate: GateMaker = no_gate
    iterations: Callable[[Trainer, Earlier], int] = all_iterations


AnyBenchPolicy = TypeVar("AnyBenchPolicy", bound=BenchPolicy)


def table_of(*specs: AnyBenchPolicy) -> dict[str, AnyBenchPolicy]:
    return {spec.name: spec for spec in specs}


def _periodic(first: int, end: int, n_skips: int, seed: int) -> PlannedSkipping:
    return periodic_skipping(first, end, n_skips)


POLICIES = table_of(
    RefineBenchPolicy(REFERENCE, "the trainer's own refinement: every iteration runs as it is"),
    RefineBenchPolicy("gate", "the paper's gate, default settings", gate=gate_with()),
    RefineBenchPolicy("gate,min_bwd_ratio=0", "the gate without a floor", gate=gate_with(min_bwd_ratio=0.0)),
    RefineBenchPolicy(
        "random",
        "control: as many backwards skipped as by the gate, drawn by chance",
        ("gate",),
        planned_as("gate", random_skipping),
    ),
    RefineBenchPolicy(
        "periodic",
        "control: as many backwards skipped as by the gate, evenly spread",
        ("gate",),
        planned_as("gate", _periodic),
    ),
    RefineBenchPolicy(
        "shortened",
        "control: no skips, fewer iterations, schedule compressed to the gate's time",
        (REFERENCE, "gate"),
        iterations=as_long_as("gate"),
    ),
    RefineBenchPolicy(
        "own,compensate",
        f"every iteration runs, with the larger, shrinking steps of {COPIED}",
        (COPIED,),
        stepping_as(COPIED),
    ),
    RefineBenchPolicy(
        COPIED, "40 % of the iterations run, with larger, shrinking steps", gate=gate_with(refine_share=0.4)
    ),
    RefineBenchPolicy(
        "refine_share=auto",
        "as many iterations as the scene needs, with larger, shrinking steps",
        gate=gate_with(refine_share="auto"),
    ),
    RefineBenchPolicy(
        f"{COPIED},no-compensate",
        "control: 40 % of the iterations run, steps as they are",
        gate=gate_with(refine_share=0.4, compensate=False),
    ),
    RefineBenchPolicy(
        "gate,compensate", "the paper's gate, with larger, shrinking steps", gate=gate_with(compensate=True)
    ),
    RefineBenchPolicy(
        "random,compensate",
        "control: random, with larger, shrinking steps",
        ("gate",),
        planned_as("gate", random_skipping, compensate=True),
    ),
    RefineBenchPolicy(
        "periodic,compensate",
        "control: periodic, with larger, shrinking steps",
        ("gate",),
        planned_as("gate", _periodic, compensate=True),
    ),
    RefineBenchPolicy(
        "shortened,compensate",
        "control: iterations left out down to the gate's time, with larger, shrinking steps",
        (REFERENCE, "gate"),
        refine_share_as_long_as("gate"),
    ),
)


def refinement_policy(name: str) -> RefineBenchPolicy | None:
    """Return the policy with this name; None if it does not exist. `refine_share=` takes any number in (0, 1]."""
    if name in POLICIES:
        return POLICIES[name]
    share = number_after("refine_share", name)
    if share is None:
        return None
    meaning = f"{100 * share:g} % of the iterations run, with larger, shrinking steps"
    return RefineBenchPolicy(name, meaning, gate=gate_with(refine_share=share))


def number_after(setting: str, name: str) -> float | None:
    """Return X of a policy named `setting=X`, in (0, 1]; None if it has another name."""
    found = re.fullmatch(rf"{setting}=(\d*\.?\d+)", name)
    return float(found[1]) if found is not None and 0.0 < float(found[1]) <= 1.0 else None


def rounds(specs: Sequence[AnyBenchPolicy], position: int) -> list[list[AnyBenchPolicy]]:
    """Return groups that run in turns: policies that copy nothing, then policies that copy from them, and so on.

    The order within a group is rotated by `position`, the place of the seed among all seeds.
    """
    waiting = list(specs)
    done: set[str] = set()
    found = []
    while waiting:
        ready = [spec for spec in waiting if done.issuperset(spec.needs)]
        waiting = [spec for spec in waiting if spec not in ready]
        done.update(spec.name for spec in ready)
        shift = position % len(ready)
        found.append(ready[shift:] + ready[:shift])
    return found
