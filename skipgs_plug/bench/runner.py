"""All runs of a bench: per seed densify once, then refine under each policy, in turns."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

from skipgs_plug.bench import provenance
from skipgs_plug.bench.policies import PolicySpec, check_policies, rounds
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.bench.refine import DivergedError, densify, refine
from skipgs_plug.bench.store import BenchFolder
from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer
from skipgs_plug.trainer.backend import resolve_backend
from skipgs_plug.trainer.clock import TrainClock
from skipgs_plug.trainer.metrics import LPIPS_WEIGHTS, require_lpips

Clock = Literal["wall", "processor"]
NOT_SETTINGS = ("data_dir", "result_dir", "seed", "backend")


class Bench:
    """Runs what is missing in a folder and returns all runs.

    Args:
        config: settings of training; its seed is replaced by each of `seeds`.
        say: called with one line per event.
        tensorboard: write TensorBoard scalars of every run that is missing.
        clock: see `TrainClock`.

    Raises:
        InputError: an unknown policy, no held-out views, processor time with a GPU, or a folder made with other
            settings.
    """

    def __init__(
        self,
        scene: Scene,
        config: TrainConfig,
        folder: BenchFolder,
        seeds: Sequence[int],
        policies: Sequence[str],
        say: Callable[[str], None] = print,
        progress: bool = True,
        tensorboard: bool = False,
        clock: Clock = "wall",
    ) -> None:
        check_policies(policies)
        if not seeds or len(set(seeds)) < len(seeds):
            raise InputError("Give at least one seed, each once.")
        stop = config.scaled(config.recipe.refine_stop_iter)
        if stop >= config.max_steps:
            raise InputError(
                f"Densification ends at iteration {stop:,} of {config.max_steps:,}, "
                "which leaves nothing to refine; lower --refine-stop-iter."
            )
        if not scene.test:
            raise InputError(f"Scene {scene.name} has no held-out views to measure on; give --test-every 8.")
        self.scene, self.config, self.folder = scene, config, folder
        self.seeds, self.policies = list(seeds), list(policies)
        self.say, self.progress, self.tensorboard = say, progress, tensorboard
        self.backend = resolve_backend(config.backend)
        self.clock = clock
        if clock == "processor" and self.backend.device.type != "cpu":
            raise InputError("A GPU works while no thread is running: --clock processor is for the CPU; leave it out.")
        self.lpips_net = available_lpips()
        self.commit = provenance.commit()
        self.settings = {
            "training": {k: v for k, v in dataclasses.asdict(config).items() if k not in NOT_SETTINGS},
            "scene": provenance.scene_facts(scene, config),
            "machine": provenance.machine(self.backend),
            "lpips": self.lpips_net,
            "clock": clock,
        }
        folder.require_settings(self.settings)

    @property
    def refine_stop_iter(self) -> int:
        """First iteration of refinement."""
        return self.config.scaled(self.config.recipe.refine_stop_iter)

    def run(self) -> list[RunRecord]:
        """Return one record per seed and policy, by seed, in the order of `policies`."""
        records = []
        for position, seed in enumerate(self.seeds):
            found = self._run_seed(seed, rounds(self.policies, position))
            records += [found[name] for name in self.policies]
        return records

    def _run_seed(self, seed: int, order: list[list[PolicySpec]]) -> dict[str, RunRecord]:
        found: dict[str, RunRecord] = {}
        for spec in itertools.chain(*order):
            stored = self.folder.load(seed, spec.name)
            if stored is not None:
                found[spec.name] = stored
        if len(found) == len(self.policies):
            return found
        try:
            snapshot = self._densified(self._trainer(seed))
        except DivergedError as error:
            for spec in itertools.chain(*order):
                if spec.name not in found:
                    note = f"{error}, during densification"
                    found[spec.name] = self._store(RunRecord(seed, spec.name, "diverged", note))
            return found
        for group in order:
            for record in self._in_turns(seed, [spec for spec in group if spec.name not in found], snapshot, found):
                found[record.policy] = self._store(record)
        return found

    def _in_turns(
        self, seed: int, specs: list[PolicySpec], snapshot: dict[str, Any], earlier: dict[str, RunRecord]
    ) -> Iterator[RunRecord]:
        """Refine `snapshot` under each policy, a part of one after a part of the other; yields what has finished.

        A machine that slows down hits all alike. Each run has a trainer of its own.
        """
        runs = {}
        for spec in specs:
            lost = [name for name in spec.needs if earlier[name].status != "done"]
            if lost:
                note = f"{lost[0]} of this seed, which it copies, did not finish"
                yield RunRecord(seed, spec.name, "not run", note)
                continue
            trainer = self._trainer(seed)
            trainer.restore(snapshot)
            runs[spec.name] = refine(trainer, spec, earlier, self.lpips_net, self._scalars(seed, spec.name))
        while runs:
            for name in list(runs):
                try:
                    next(runs[name])
                except StopIteration as finished:
                    del runs[name]
                    yield finished.value
                except DivergedError as error:
                    del runs[name]
                    yield RunRecord(seed, name, "diverged", str(error))

    def _trainer(self, seed: int) -> Trainer:
        trainer = Trainer(dataclasses.replace(self.config, seed=seed), self.scene, self.backend)
        trainer.clock = TrainClock(self.backend.device, by_processor=self.clock == "processor")
        return trainer

    def _densified(self, trainer: Trainer) -> dict[str, Any]:
        seed, path = trainer.config.seed, self.folder.snapshot(trainer.config.seed)
        if path.is_file():
            trainer.load_checkpoint(path)
            self.say(f"seed {seed}: continuing from its snapshot at iteration {trainer.step:,}")
        else:
            densify(trainer, self.progress, self._scalars(seed, "densify"))
            trainer.save_checkpoint(path)
            count = trainer.num_gaussians
            self.say(f"seed {seed}: densified to {count:,} Gaussians in {trainer.t_total:.1f} s of training")
        return trainer.snapshot()

    def _scalars(self, seed: int, name: str) -> Path | None:
        return self.folder.scalars(seed, name) if self.tensorboard else None

    def _store(self, record: RunRecord) -> RunRecord:
        record.commit = self.commit
        self.folder.store(record)
        if record.status == "done":
            share = 100 * record.backwards / record.iterations
            self.say(
                f"seed {record.seed}: {record.policy:16} T_post {record.t_post:7.1f} s, "
                f"{record.backwards:,} of {record.iterations:,} backwards ({share:.0f} %), "
                f"PSNR {record.metrics['psnr']:.2f} dB"
            )
        else:
            self.say(f"seed {record.seed}: {record.policy:16} {record.status}: {record.note}")
        return record


def available_lpips() -> str | None:
    """Return the first LPIPS backbone whose weights are on this machine."""
    for net in LPIPS_WEIGHTS:
        try:
            require_lpips(net)
        except InputError:
            continue
        return net
    return None
