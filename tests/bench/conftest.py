"""A bench small enough to run whole."""

from __future__ import annotations

import pytest
from bench_fixtures import Finished, early_floor, make_bench

from skipgs_plug.trainer import Scene
from skipgs_plug.trainer.synthetic import make_scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return make_scene(n_views=8, width=24, height=16, n_points=60, test_every=4)


@pytest.fixture(scope="session")
def finished(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    folder = tmp_path_factory.mktemp("bench")
    bench = make_bench(scene, folder)
    with early_floor():
        return Finished(bench, bench.run(), folder)
