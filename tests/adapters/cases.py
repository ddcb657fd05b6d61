"""One case for each look-alike: how to make its trainer, how to run it, and the expected results."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import pytest
import torch
from lookalikes import (
    absgs,
    dash_gaussian,
    deformable,
    edgs,
    faster_gs,
    fastgs,
    fvdb,
    fvdb_frgs,
    gaussianspa,
    gaussianspa_op,
    gns,
    gof,
    gsplat_runner,
    improved_gs,
    inria,
    lightgaussian_densify_prune,
    lightgaussian_distill,
    lightgaussian_prune_finetune,
    litegs,
    mcmc,
    mini_splatting,
    mini_splatting2,
    mip_splatting,
    nerfstudio,
    octree_gs,
    perceptual_gs,
    pgsr,
    pixel_gs,
    scaffold_gs,
    speedy_splat,
    step_trainer,
    taming,
    threedgrut,
    two_d_gs,
)
from lookalikes.splats import NAMES, Log, log, new_log

from skipgs_plug import SkipGate
from skipgs_plug.core import decision
from skipgs_plug.core.policy import Policy

PAUSE = 4  # iterations of a pause


@dataclass(frozen=True)
class Case:
    """A trainer and its behaviour without a gate.

    Attributes:
        name: Name of the test.
        module: The look-alike. It has ADAPTER and the numbers of three iterations, FIRST, START and LAST.
        make: Returns the trainer and a function `train(last)` that runs it.
        resume: Returns another trainer and its `train`, which continue from a copy of the result of `train`.
        settled: Iteration from which nothing changes when everything is skipped.
        pending: Whether gradients are left over when skipping begins. They must be applied right before `settled`.
        views: Keys of all training views.
        leaves_out: Whether its loop counts with a range, so that whole iterations can be left out.
        later: First iteration that may be skipped, if it is not START of the module.
    """

    name: str
    module: ModuleType
    make: Callable[[], tuple[Any, Callable[..., Any]]]
    resume: Callable[[Any], tuple[Any, Callable[..., Any]]] | None = None
    settled: int | None = None
    pending: bool = False
    views: tuple[Any, ...] = tuple(NAMES)
    leaves_out: bool = True
    later: int | None = None

    @property
    def start(self) -> int:
        """Return the first iteration that may be skipped."""
        return self.module.START if self.later is None else self.later

    @property
    def refined_from(self) -> int:
        """Return the first iteration that refinement may leave out: SETTLED of the module, or the start."""
        return getattr(self.module, "SETTLED", self.start)

    @property
    def iterations(self) -> range:
        return range(self.module.FIRST, self.module.LAST + 1)


def script(
    name: str,
    module: ModuleType,
    settled: int | None = None,
    pending: bool = False,
    views: Any = NAMES,
    later: int | None = None,
    **options: Any,
) -> Case:
    """A train module with its function `training`; resumed with the cameras in another order."""

    def make() -> tuple[Any, Callable[..., Any]]:
        return module, lambda last=module.LAST: module.train(last=last, **options)

    def resume(checkpoint: Any) -> tuple[Any, Callable[..., Any]]:
        return module, lambda last=module.LAST: module.train(checkpoint, last=last, order=7, **options)

    return Case(name, module, make, resume, settled, pending, tuple(views), later=later)


def gsplat(name: str, cls: type, strategy: type, **options: Any) -> Case:
    def make() -> tuple[Any, Callable[..., Any]]:
        runner = cls(strategy(), **options)
        return runner, runner.train

    return Case(name, gsplat_runner, make, views=("batch",) if options else tuple(NAMES))


def studio(name: str, **options: Any) -> Case:
    def make() -> tuple[Any, Callable[..., Any]]:
        trainer = nerfstudio.Trainer(**options).setup()
        return trainer, lambda last=nerfstudio.LAST: (trainer.train(last), trainer, last)[1:]

    def resume(result: Any) -> tuple[Any, Callable[..., Any]]:
        trainer, last = result
        trainer.start_step = last + 1
        return trainer, trainer.train

    return Case(name, nerfstudio, make, resume)


def pip() -> Case:
    def make() -> tuple[Any, Callable[..., Any]]:
        trainer, dataset = step_trainer.make(), step_trainer.dataset()
        return trainer, lambda last=step_trainer.LAST: (step_trainer.training(trainer, dataset, last), trainer)[1]

    def resume(trainer: Any) -> tuple[Any, Callable[..., Any]]:
        trainer = copy.deepcopy(trainer)
        dataset = step_trainer.dataset()
        return trainer, lambda last=step_trainer.LAST: step_trainer.training(trainer, dataset, last)

    return Case("step_trainer", step_trainer, make, resume, leaves_out=False)


def runner(
    name: str,
    module: ModuleType,
    cls: type,
    method: str,
    views: Any = NAMES,
    again: Callable[[Any], None] = lambda trainer: None,
    settled: int | None = None,
    **options: Any,
) -> Case:
    """A trainer object whose method trains up to an iteration; resumed as a copy, which `again` prepares."""

    def trained(trainer: Any) -> tuple[Any, Callable[..., Any]]:
        arguments = (None,) if method == "run" else ()
        return trainer, lambda last=module.LAST: getattr(trainer, method)(*arguments, last=last)

    def resume(result: Any) -> tuple[Any, Callable[..., Any]]:
        trainer = copy.deepcopy(result)
        again(trainer)
        return trained(trainer)

    return Case(name, module, lambda: trained(cls(**options)), resume, settled, views=tuple(views), leaves_out=False)


def lite() -> Case:
    def make() -> tuple[Any, Callable[..., Any]]:
        return litegs, lambda last=litegs.LAST: litegs.train(last)

    return Case("litegs", litegs, make, leaves_out=False)


def frgs(name: str, **options: Any) -> Case:
    def make() -> tuple[Any, Callable[..., Any]]:
        trainer = fvdb_frgs.GaussianSplatReconstruction(**options)
        return trainer, trainer.optimize

    return Case(name, fvdb_frgs, make, views=tuple(str(i) for i in range(len(NAMES))), leaves_out=False)


def passes_over(trainer: Any) -> None:
    """Resume a runner: it takes all minibatches again, and trains on the new ones."""
    trainer._start_step = trainer._global_step


SCRIPTS = [
    script("inria", inria),
    script("fastgs", fastgs, settled=25, pending=True),
    script("taming", taming, settled=21),
    script("taming_sh_lower", taming, settled=25, pending=True, sh_lower=True),
    script("speedy_splat", speedy_splat),
    script("lightgaussian_densify_prune", lightgaussian_densify_prune),
    script("lightgaussian_prune_finetune", lightgaussian_prune_finetune),
    script("lightgaussian_distill", lightgaussian_distill, views=lightgaussian_distill.VIEWS),
    script("lightgaussian_distill_plain", lightgaussian_distill, augmented_view=False),
    script("gaussianspa", gaussianspa),
    script("gaussianspa_op", gaussianspa_op),
    script("mcmc", mcmc),
    script("mip_splatting", mip_splatting),
    script("absgs", absgs),
    script("absgs_prune_weight", absgs, later=40, use_prune_weight=True, prune_until_iter=40),
    script("pixel_gs", pixel_gs),
    script("two_d_gs", two_d_gs),
    script("scaffold_gs", scaffold_gs),
    script("dash_gaussian", dash_gaussian),
    script("improved_gs", improved_gs),
    script("deformable", deformable),
    script("gns", gns),
    script("gof", gof),
    script("mini_splatting", mini_splatting),
    script("mini_splatting2", mini_splatting2),
    script("octree_gs", octree_gs),
    script("perceptual_gs", perceptual_gs),
    script("pgsr", pgsr),
]
CASES = [
    *SCRIPTS,
    gsplat("gsplat_default", gsplat_runner.Runner, gsplat_runner.DefaultStrategy),
    gsplat("gsplat_mcmc", gsplat_runner.Runner, gsplat_runner.MCMCStrategy),
    gsplat("gsplat_head_default", gsplat_runner.HeadRunner, gsplat_runner.DefaultStrategy),
    gsplat("gsplat_head_mcmc", gsplat_runner.HeadRunner, gsplat_runner.MCMCStrategy),
    gsplat("gsplat_batch", gsplat_runner.Runner, gsplat_runner.DefaultStrategy, batch_size=2),
    pip(),
    lite(),
    runner("faster_gs", faster_gs, faster_gs.FasterGSTrainer, "run", views=[str(i) for i in range(len(NAMES))]),
    runner("faster_gs_mcmc", faster_gs, faster_gs.FasterGSTrainer, "run", ["0", "1", "2", "3", "4"], mcmc=True),
    runner("edgs", edgs, edgs.EDGSTrainer, "train"),
    runner("3dgrut", threedgrut, threedgrut.Trainer3DGRUT, "run_training"),
    runner("3dgrut_mcmc", threedgrut, threedgrut.Trainer3DGRUT, "run_training", strategy=threedgrut.MCMCStrategy),
    frgs("fvdb_frgs"),
    frgs("fvdb_frgs_mcmc", optimizer=fvdb_frgs.OptimizerMCMC),
    runner("fvdb", fvdb, fvdb.SceneOptimizationRunner, "train", ["0", "1", "2", "3", "4"], passes_over, 26),
    studio("nerfstudio"),
    studio("nerfstudio_mcmc", strategy=gsplat_runner.MCMCStrategy()),
    studio("nerfstudio_scaled", scaled=True, max_norm=1.0),
]


class SkipAlways(Policy):
    """A policy that skips every backward pass."""

    def decide(self, view, loss, step):
        return decision.AT_OR_BELOW_MEAN

    def notify_event(self, step, n_views):
        pass

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


@functools.cache
def alone(case: Case) -> Any:
    """Return the log of a trainer without a gate. All tests share it, so they must not change it."""
    return run(case)[0]


def note_begun(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that gets the numbers of the iterations that begin, for the length of a test."""
    numbers: list[int] = []
    original = Log.begins

    def begins(self: Log, iteration: int, parameters: Any) -> None:
        numbers.append(iteration)
        return original(self, iteration, parameters)

    monkeypatch.setattr(Log, "begins", begins)
    return numbers


def same(one: Sequence[torch.Tensor], other: Sequence[torch.Tensor]) -> bool:
    """Whether as many tensors are equal to the bit."""
    return len(one) == len(other) and all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def run(case: Case, **settings: Any) -> tuple[Any, SkipGate | None]:
    """Train a fresh trainer to the end, gated if there are settings; give the log and the detached gate."""
    new_log()
    trainer, train = case.make()
    if not settings:
        train()
        return copy.copy(log), None
    with SkipGate(trainer, **settings) as gate:
        train()
    gate.verify()
    return copy.copy(log), gate


RULE = {"warmup": 3, "min_bwd_ratio": 0.0, "pause_iters": PAUSE, "record_trace": True}
