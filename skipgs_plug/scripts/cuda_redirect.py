"""Run code for CUDA on the CPU: every request for a CUDA tensor gives a CPU tensor.

Together with `compat`, this module runs an unmodified training script on a machine without a GPU. It emulates only
placement, clocks, and facts about the device. Everything else (streams, graphs, CUDA generators) fails as in any
PyTorch without CUDA.
"""

from __future__ import annotations

import functools
import importlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from skipgs_plug.compat.child_processes import also_in_children
from skipgs_plug.compat.stand_ins import stand_ins
from skipgs_plug.limits import free_memory
from skipgs_plug.scripts.threads import also_in_threads

DEVICE_NAME = "CPU"


class HostEvent:
    """A `torch.cuda.Event` that reads the host's clock: on the CPU, all earlier calls have finished."""

    def __init__(self, enable_timing: bool = False, blocking: bool = False, interprocess: bool = False) -> None:
        self._time: float | None = None

    def record(self, stream: Any = None) -> None:
        """Store the current time."""
        self._time = time.perf_counter()

    def elapsed_time(self, end_event: HostEvent) -> float:
        """Return the milliseconds from this event to `end_event`.

        Raises:
            RuntimeError: One of the two events was never recorded.
        """
        if self._time is None or end_event._time is None:
            raise RuntimeError("Both events must be recorded before elapsed_time.")
        return 1000.0 * (end_event._time - self._time)

    def query(self) -> bool:
        """Return True: on the CPU, the work before the event is always done."""
        return True

    def synchronize(self) -> None:
        """Return at once: on the CPU, the work before the event is always done."""


def _nothing(*args: Any, **kwargs: Any) -> None:
    """Do nothing. Replaces calls that matter only on a GPU."""


def _properties(device: Any = None) -> SimpleNamespace:
    """Return the fields of `torch.cuda.get_device_properties` that scripts print or decide by."""
    cores = os.cpu_count() or 1
    return SimpleNamespace(name=DEVICE_NAME, major=0, minor=0, total_memory=free_memory(), multi_processor_count=cores)


# Names that `cuda_on_cpu` replaces, and restores on exit.
REPLACED: dict[str, Any] = {
    "torch.cuda.Event": HostEvent,
    "torch.cuda.synchronize": _nothing,
    "torch.cuda.set_device": _nothing,
    "torch.cuda.reset_peak_memory_stats": _nothing,
    "torch.cuda.reset_max_memory_allocated": _nothing,
    "torch.cuda.set_per_process_memory_fraction": _nothing,
    "torch.cuda.ipc_collect": _nothing,
    "torch.cuda.current_device": lambda: 0,
    # Scripts assert that a device is available, and count devices to start one process for each.
    "torch.cuda.is_available": lambda: True,
    "torch.cuda.device_count": lambda: 1,
    # Scripts print these, name a run after them, or choose a precision or a size by them.
    "torch.cuda.get_device_name": lambda device=None: DEVICE_NAME,
    "torch.cuda.get_device_properties": _properties,
    "torch.cuda.get_device_capability": lambda device=None: (0, 0),
    "torch.cuda.mem_get_info": lambda device=None: (free_memory(),) * 2,  # free and total
    "torch.cuda.memory_summary": lambda device=None, abbreviated=False: "",
    # `torch.autocast("cuda", torch.bfloat16)` asks this; on the CPU, it changes nothing.
    "torch.cuda.is_bf16_supported": lambda including_emulation=True: True,
    # Torch's optimizers call this when a device is available. A build with CUDA raises an error without a driver.
    "torch.cuda.is_current_stream_capturing": lambda: False,
    "torch.cuda.FloatTensor": torch.FloatTensor,
    "torch.cuda.IntTensor": torch.IntTensor,
    "torch.cuda.LongTensor": torch.LongTensor,
    "torch.cuda.BoolTensor": torch.BoolTensor,
    # Torch's optimizers call this; None keeps them on their CPU path.
    "torch.accelerator.current_accelerator": _nothing,
}


@contextmanager
def cuda_on_cpu() -> Iterator[None]:
    """Redirect CUDA to the CPU inside the block, and in threads and processes that are started there."""
    # `_in_one_thread` first: it imports dynamo, which lists the functions of torch.cuda and fails if they are replaced.
    with (
        _in_one_thread(),
        stand_ins([*_places(), *_engine(), (torch, "load", _load_on_cpu(torch.load))]),
        also_in_threads(_in_one_thread),
        also_in_children(cuda_on_cpu),
    ):
        yield


@contextmanager
def _in_one_thread() -> Iterator[None]:
    dynamo = importlib.import_module("torch._dynamo")
    # The compiler would ask CUDA for its random state. Uncompiled functions give the same results.
    with _CpuPlacement(), dynamo.config.patch(disable=True):
        yield


def _places() -> list[tuple[Any, str, Any]]:
    """Return module, name and stand-in of each replaced function. Torch before 2.6 has no module `accelerator`."""
    split = ((*name.split(".")[1:], stand_in) for name, stand_in in REPLACED.items())
    return [(getattr(torch, module), name, stand_in) for module, name, stand_in in split if hasattr(torch, module)]


def _engine() -> list[tuple[Any, str, Any]]:
    """Return the function of torch that runs every backward pass, with a stand-in that redirects the script's own code.

    `Tensor.backward` calls it with all function modes off, but it also runs `backward` of the script's
    `autograd.Function`s, and hooks. The name is private to torch.
    """
    name = "_engine_run_backward"
    if not hasattr(torch.autograd, name):
        return []
    run = getattr(torch.autograd, name)

    @functools.wraps(run)
    def redirected(*args: Any, **kwargs: Any) -> Any:
        with _CpuPlacement():
            return run(*args, **kwargs)

    return [(torch.autograd, name, redirected)]


@contextmanager
def exclusive_cores() -> Iterator[None]:
    """Limit torch to one thread inside the block: the CPU rasterizer, which replaces the GPU, has its own threads.

    Torch's idle OpenMP threads spin for a while after each operation and keep the cores from the rasterizer.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with also_in_children(exclusive_cores):
            yield
    finally:
        torch.set_num_threads(before)


class _CpuPlacement(TorchFunctionMode):
    def __torch_function__(
        self, func: Callable, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func in _MOVES:
            return args[0]
        kwargs = kwargs or {}
        # A script calls hundreds of functions of torch per iteration, and few of them name a device.
        named = not _DEVICES.isdisjoint(map(type, args)) or (kwargs and not _KEYWORDS.isdisjoint(kwargs))
        if named or func is torch.Tensor.to:
            args, kwargs = _placed(func, args, kwargs)
        return func(*args, **kwargs)


_MOVES = frozenset({torch.Tensor.cuda, torch.Tensor.pin_memory})
_DEVICES = frozenset({str, torch.device})  # types of a positional argument that can name a device
_KEYWORDS = frozenset({"device", "pin_memory"})


def _placed(func: Callable, args: tuple, kwargs: dict[str, Any]) -> tuple[tuple, dict[str, Any]]:
    """Return the arguments of a call with the CPU in place of CUDA devices, and without pinned memory."""
    if func is torch.Tensor.to and len(args) > 1 and type(args[1]) is int:
        args = (args[0], "cpu", *args[2:])
    args = tuple("cpu" if _is_cuda(value) else value for value in args)
    device = kwargs.get("device")
    if _is_cuda(device) or type(device) is int:
        kwargs = {**kwargs, "device": "cpu"}
    if kwargs.get("pin_memory"):
        kwargs = {**kwargs, "pin_memory": False}
    return args, kwargs


def _is_cuda(value: Any) -> bool:
    if isinstance(value, str):
        return value == "cuda" or value.startswith("cuda:")
    return isinstance(value, torch.device) and value.type == "cuda"


def _load_on_cpu(load: Callable) -> Callable:
    def load_on_cpu(f: Any, map_location: Any = None, *args: Any, **kwargs: Any) -> Any:
        if map_location is None or _is_cuda(map_location):
            map_location = "cpu"
        return load(f, map_location, *args, **kwargs)

    return load_on_cpu
