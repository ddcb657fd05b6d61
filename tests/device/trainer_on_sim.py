"""The trainer of this package, and the measurements of benchmarks/gpu, on the simulated device; prints JSON.

It runs in a process of its own, like `lookalikes_on_sim.py`.
"""

from __future__ import annotations

import contextlib
import json
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "adapters"), str(Path(__file__).parents[2])]

from lookalikes_on_sim import MadeOnSim, rasterization_on_sim  # noqa: E402
from simulated import SIM, OnSim, host  # noqa: E402


class SimMachine:
    """Run the measurements of benchmarks/gpu on a device."""

    name = "sim"

    def synchronize(self) -> None: ...

    def reset_peak(self) -> None: ...

    def peak_bytes(self) -> int:
        return 0

    @contextlib.contextmanager
    def waits(self) -> Iterator[list[int]]:
        count = [0]
        host.take()
        yield count
        count[0] = sum(host.take().values())


def main() -> None:
    warnings.simplefilter("ignore")
    from benchmarks.gpu.measure import Deadline, compare
    from skipgs_plug.fallback_raster import rasterization
    from skipgs_plug.trainer import TrainConfig, Trainer
    from skipgs_plug.trainer.backend import Backend
    from skipgs_plug.trainer.loss import l1_ssim_loss
    from skipgs_plug.trainer.photographs import Photographs
    from skipgs_plug.trainer.synthetic import make_scene

    scene = make_scene(n_views=6, width=24, height=20, n_points=60)
    result: dict[str, Any] = {}
    with OnSim(), MadeOnSim():
        backend = Backend("gsplat", SIM, rasterization_on_sim(rasterization), l1_ssim_loss)
        for name, free in (("resident", 1 << 40), ("ahead", 0)):
            trainer = Trainer(TrainConfig(max_steps=400), scene, backend)
            trainer._photographs = Photographs(scene.train, SIM, free)
            trainer.step = trainer.refine_stop_iter
            trainer.train(trainer.step + 3, progress=False)
            host.take()
            trainer.train(trainer.step + 10, progress=False)
            taken = host.take()
            result[name] = [[kind, file.rsplit("/", 1)[-1], line, n] for (kind, file, line, _), n in taken.items()]
        result["compare"] = compare(scene, backend, SimMachine(), Deadline(60.0, lambda: 0.0), steps=200)
    json.dump(result, sys.stdout)


if __name__ == "__main__":
    main()
