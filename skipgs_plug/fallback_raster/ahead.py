"""The kernels of training, loaded on spare threads while a program still reads its data.

A kernel that was never compiled on this machine takes up to some seconds. Nearly all of that is spent in Warp's
compiler, which needs no interpreter lock, so threads compile side by side.
"""

import threading
from collections.abc import Callable, Iterable
from typing import Any

from .runtime.cores import usable_cores
from .runtime.launch import Worker
from .runtime.thread_pool import load_pool_kernels
from .runtime.threads import get_num_threads
from .stages.binning import fill_pairs, pack_and_count, scan_pairs
from .stages.blend import ADJOINT, FORWARD
from .stages.project import list_visible, project_forward
from .stages.rows import _take_rows
from .stages.sh import sh_forward
from .stages.splat_adjoint import splat_adjoint
from .training.adam import _adam
from .training.gradient_norms import _sum_norms
from .training.lazy_adam import _catch_up
from .training.loss import _LOSS_TILES, BYTES

COLOURS = 3  # channels of an image


def load_kernels_ahead(absgrad: bool = False, lazy: bool = True, densify: bool = True) -> list[threading.Thread]:
    """Load the kernels that training needs on as many threads as there are cores, those needed first before others.

    Whoever runs a kernel that is not there yet waits for it, or loads it. What depends on the scene is left to that.
    With one core nothing is done: nobody would gain.

    Args:
        absgrad: Absolute gradients of 2D means are computed too.
        lazy: Colours are stepped by `LazyAdam`.
        densify: Gradients of 2D means are summed up.

    Returns:
        The threads, which end by themselves, and early when the main thread has ended.
    """
    several = get_num_threads() > 1
    loads: list[Callable[[], object]] = [load_pool_kernels] if several else []
    absolute = [ADJOINT[COLOURS, True]] if absgrad else []
    workers: list[Worker[Any]] = [
        _take_rows, project_forward, list_visible, sh_forward, pack_and_count, scan_pairs, fill_pairs,
        FORWARD[COLOURS], _LOSS_TILES[BYTES], *absolute, ADJOINT[COLOURS, False], splat_adjoint,
        _adam, *([_catch_up] if lazy else []), *([_sum_norms] if densify else []),
    ]  # fmt: skip
    loads += [worker.load for worker in workers]
    return run_aside(loads, min(usable_cores(), len(loads))) if usable_cores() > 1 else []


def run_aside(calls: Iterable[Callable[[], object]], count: int) -> list[threading.Thread]:
    """Make the calls on `count` threads, each as soon as one is free, and return the threads.

    A thread whose call fails ends: what the call was to prepare fails again where it is needed, and is reported there.
    """
    pending, taking = iter(calls), threading.Lock()

    def serve() -> None:
        while threading.main_thread().is_alive():  # at the end of a program Python waits for its threads
            with taking:
                call = next(pending, None)
            if call is None:
                return
            try:
                call()
            except Exception:
                return

    threads = [threading.Thread(target=serve, name="skipgs_plug kernels") for _ in range(count)]
    for thread in threads:
        thread.start()
    return threads
