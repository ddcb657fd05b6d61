"""Loads the kernels of training on spare threads while a program still reads its data.

Compiling a kernel for the first time on a machine takes up to a few seconds. Nearly all of that time is spent in Warp's
compiler, which does not hold the interpreter lock, so several threads can compile at the same time.
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
from .training.loss import _LOSS_TILES, PHOTO_DTYPE

RGB_CHANNELS = 3  # number of channels of images in training; kernels for other numbers are not loaded ahead


def load_kernels_ahead(absgrad: bool = False, lazy: bool = True, densify: bool = True) -> list[threading.Thread]:
    """Load the kernels that training needs on as many threads as there are cores, those that compile longest first.

    The first iteration needs nearly all of them, so it begins when the last one is loaded. A call of a kernel that is
    not loaded yet waits for it, or loads it. Kernels that only some scenes need are not loaded ahead. With one core
    nothing is done, because nothing could run at the same time.

    Args:
        absgrad: Whether absolute gradients of 2D means are computed.
        lazy: Whether `LazyAdam` steps the SH coefficients.
        densify: Whether gradients of 2D means are accumulated for densification.

    Returns:
        The threads. They end by themselves, and early when the main thread has ended.
    """
    several = get_num_threads() > 1
    loads: list[Callable[[], object]] = [load_pool_kernels] if several else []
    absolute = [ADJOINT[RGB_CHANNELS, True]] if absgrad else []
    workers: list[Worker[Any]] = [
        splat_adjoint, FORWARD[RGB_CHANNELS], pack_and_count, _LOSS_TILES[PHOTO_DTYPE], project_forward, sh_forward,
        *absolute, ADJOINT[RGB_CHANNELS, False], *([_catch_up] if lazy else []), fill_pairs, _adam,
        _take_rows, list_visible, scan_pairs, *([_sum_norms] if densify else []),
    ]  # fmt: skip
    loads += [worker.load for worker in workers]
    return run_aside(loads, min(usable_cores(), len(loads))) if usable_cores() > 1 else []


def run_aside(calls: Iterable[Callable[[], object]], count: int) -> list[threading.Thread]:
    """Make the calls on `count` threads and return the threads. A free thread takes the next call.

    A thread whose call raises ends. The kernel that was to be loaded is loaded again when it is needed, and that
    failure is reported.
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
