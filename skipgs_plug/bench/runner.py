"""All runs of a bench, in turns: one densification per seed with a refinement per policy, or whole runs."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Generator, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from skipgs_plug.bench import provenance
from skipgs_plug.bench.choices import Clock
from skipgs_plug.bench.find import find_policy, require_policies
from skipgs_plug.bench.policies import BenchPolicy, Earlier, refinement_policy, rounds
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.bench.refine import NotRunError, RunDivergedError, densify, refine
from skipgs_plug.bench.store import BenchFolder
from skipgs_plug.bench.whole import Maker
from skipgs_plug.bench.whole_policies import whole_policy
from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer
from skipgs_plug.trainer.backend import resolve_backend
from skipgs_plug.trainer.clock import TrainClock
from skipgs_plug.trainer.metrics import LPIPS_WEIGHTS, require_lpips

NOT_SETTINGS = ("data_dir", "result_dir", "seed", "backend")
WARM_UP = 20  # iterations before the first run: loading and compiling must not count as its memory
Begin = Callable[[str, Earlier], Generator[None, None, RunRecord]]


class Bench:
    """Runs the missing runs of a folder and returns all runs.

    Args:
        scene: The scene, with held-out views.
        config: Settings of training. Each of `seeds` replaces its seed.
        folder: Folder for runs and results.
        seeds: Seeds of training.
        policies: Names of the policies.
        say: Called with one line per event.
        progress: Show progress bars.
        tensorboard: Write TensorBoard scalars of every missing run.
        clock: Clock of the compared times, see `TrainClock`. None: processor seconds for whole runs on the CPU, else
            wall time.
        whole: Each policy trains from the first iteration on, instead of from one densification per seed.

    Raises:
        InputError: A policy is unknown, the scene has no held-out views, processor time is asked for on a GPU, or the
            folder was made with other settings.
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
        clock: Clock | None = None,
        whole: bool = False,
    ) -> None:
        require_policies(policies, whole)
        if not seeds or len(set(seeds)) < len(seeds):
            raise InputError("Give at least one seed, each once.")
        stop = config.scaled(config.recipe.refine_stop_iter)
        if stop >= config.max_steps and not whole:
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
        self.whole = whole
        self.clock = clock or ("processor" if whole and self.backend.device.type == "cpu" else "wall")
        if clock == "processor" and self.backend.device.type != "cpu":
            raise InputError("Processor seconds do not include the work of a GPU; leave out --clock processor.")
        self.lpips_net = available_lpips()
        self.commit = provenance.commit()
        self.settings = {
            "training": {k: v for k, v in dataclasses.asdict(config).items() if k not in NOT_SETTINGS},
            "scene": provenance.scene_facts(scene, config),
            "machine": provenance.machine(self.backend),
            "lpips": self.lpips_net,
            "whole": whole,
            "clock": self.clock,
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
            specs = [spec for name in self.policies if (spec := find_policy(name, self.whole)) is not None]
            found = self._run_seed(seed, rounds(specs, position))
            records += [found[name] for name in self.policies]
        return records

    def _run_seed(self, seed: int, order: list[list[BenchPolicy]]) -> dict[str, RunRecord]:
        found: dict[str, RunRecord] = {}
        for spec in itertools.chain(*order):
            stored = self.folder.load(seed, spec.name)
            if stored is not None:
                found[spec.name] = stored
        if len(found) == len(self.policies):
            return found
        try:
            begin = self._whole_runs(seed) if self.whole else self._refinements(seed)
        except RunDivergedError as error:
            for spec in itertools.chain(*order):
                if spec.name not in found:
                    note = f"{error}, during densification"
                    found[spec.name] = self._store(RunRecord(seed, spec.name, "diverged", note))
            return found
        for group in order:
            for record in self._in_turns(seed, [spec for spec in group if spec.name not in found], begin, found):
                found[record.policy] = self._store(record)
        return found

    def _in_turns(
        self, seed: int, specs: list[BenchPolicy], begin: Begin, earlier: dict[str, RunRecord]
    ) -> Iterator[RunRecord]:
        """Train under each policy, taking turns by part; yield each finished run.

        A machine that slows down affects all policies alike. Each run has a trainer of its own.
        """
        runs = {}
        for spec in specs:
            lost = [name for name in spec.needs if earlier[name].status != "done"]
            if lost:
                note = f"it copies {lost[0]} of this seed, which did not finish"
                yield RunRecord(seed, spec.name, "not run", note)
                continue
            runs[spec.name] = begin(spec.name, earlier)
        while runs:
            for name in list(runs):
                try:
                    next(runs[name])
                except StopIteration as finished:
                    del runs[name]
                    yield finished.value
                except RunDivergedError as error:
                    del runs[name]
                    yield RunRecord(seed, name, "diverged", str(error))
                except NotRunError as error:
                    del runs[name]
                    yield RunRecord(seed, name, "not run", str(error))

    def _refinements(self, seed: int) -> Begin:
        """Densify once; return a function that refines the snapshot under a policy."""
        snapshot = self._densified(self._trainer(seed))

        def begin(name: str, earlier: Earlier) -> Generator[None, None, RunRecord]:
            trainer, spec = self._trainer(seed), refinement_policy(name)
            assert spec is not None
            trainer.restore(snapshot)
            return refine(trainer, spec, earlier, self.lpips_net, self._scalars(seed, name))

        return begin

    def _whole_runs(self, seed: int) -> Begin:
        """Return a function that trains under a policy from the first iteration on."""
        self._trainer(seed).train(until=WARM_UP, progress=False)

        def begin(name: str, earlier: Earlier) -> Generator[None, None, RunRecord]:
            record, spec = RunRecord(seed, name), whole_policy(name)
            assert spec is not None
            make = Maker(partial(self._trainer, seed), self.lpips_net, self._scalars(seed, name))
            yield from spec.run(make, earlier, record)
            return record

        return begin

    def _trainer(self, seed: int, **changes: Any) -> Trainer:
        trainer = Trainer(dataclasses.replace(self.config, seed=seed, **changes), self.scene, self.backend)
        trainer.clock = TrainClock(self.backend.device, by_processor=self.clock == "processor", phases=True)
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
            percent = 100 * record.backwards / record.iterations
            time = f"T_total {record.t_total:7.1f} s" if self.whole else f"T_post {record.t_post:7.1f} s"
            self.say(
                f"seed {record.seed}: {record.policy:24} {time}, "
                f"{record.backwards:,} of {record.iterations:,} backwards ({percent:.0f} %), "
                f"{record.metrics['num_GS']:,} Gaussians, PSNR {record.metrics['psnr']:.2f} dB"
            )
        else:
            self.say(f"seed {record.seed}: {record.policy:24} {record.status}: {record.note}")
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
