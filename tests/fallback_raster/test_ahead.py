"""Kernels are loaded ahead on several threads: each once, exactly those that a run needs."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from skipgs_plug.fallback_raster.ahead import run_aside
from skipgs_plug.fallback_raster.runtime import launch

# Prints the kernels that were loaded ahead, those loaded later, and those that a run of six iterations used.
TRAINED = """
import threading
from skipgs_plug.fallback_raster import ahead, load_kernels_ahead, set_num_threads
from skipgs_plug.fallback_raster.runtime import launch, thread_pool
from skipgs_plug.trainer import TrainConfig, Trainer
from skipgs_plug.trainer.synthetic import make_scene

ahead.usable_cores = lambda: 2
set_num_threads(2)
early, late, used = set(), set(), {{"pool_serve", "pool_run"}}
load, call = launch.load_kernel, launch.Worker.__call__

def loading(name, *rest):
    (late if threading.current_thread() is threading.main_thread() else early).add(name)
    return load(name, *rest)

def calling(self, *arguments, **named):
    used.add(self.name)
    return call(self, *arguments, **named)

launch.load_kernel = thread_pool.load_kernel = loading
launch.Worker.__call__ = calling
for thread in load_kernels_ahead(**{options!r}):
    thread.join()
config = TrainConfig(backend="warp", max_steps=6, **{settings!r})
Trainer(config, make_scene(n_views=4, width=32, height=24, n_points=60)).train(progress=False)
print(*sorted(early), sep=",")
print(*sorted(late), sep=",")
print(*sorted(used), sep=",")
"""


@pytest.mark.parametrize(
    ("options", "settings"),
    [({}, {}), ({"absgrad": True}, {"absgrad": True}), ({"lazy": False}, {"visible_adam": True})],
    ids=["plain", "absgrad", "visible_adam"],
)
def test_exactly_the_kernels_of_a_run_are_loaded_ahead(options: dict[str, bool], settings: dict[str, bool]) -> None:
    code = TRAINED.format(options=options, settings=settings)
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    early, late, used = ended.stdout.splitlines()
    assert early == used and not late


def test_calls_are_made_in_order_and_side_by_side() -> None:
    met = threading.Barrier(2, timeout=60)  # it breaks unless two calls run at the same time
    made: list[int] = []

    def call(number: int) -> None:
        made.append(number)
        met.wait()

    for thread in run_aside([lambda number=number: call(number) for number in range(6)], 2):
        thread.join()
    assert sorted(made) == made == list(range(6))


def test_a_call_that_fails_is_left_to_whoever_needs_its_result() -> None:
    made: list[str] = []

    def fail() -> None:
        raise OSError("the disk is full")

    for thread in run_aside([fail, lambda: made.append("second")], 1):
        thread.join()
    assert made == []
    for thread in run_aside([fail, lambda: made.append("second")], 2):
        thread.join()
    assert made == ["second"]


def test_a_kernel_is_loaded_once_whoever_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[str] = []
    loaded = object()
    both = threading.Barrier(2, timeout=60)

    def load(name: str, *rest: object) -> object:
        begun.append(name)
        return loaded

    monkeypatch.setattr(launch, "load_kernel", load)

    def stub(*, n: int) -> None: ...

    worker = launch.Worker("twice", stub, "", None, (), {}, alone=True)
    found: list[object] = []

    def ask() -> None:
        both.wait()
        found.append(worker.load())

    threads = [threading.Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert begun == ["twice"] and found == [loaded, loaded]
