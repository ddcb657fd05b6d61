"""A second device in pure Python: its tensors compute on the CPU, refuse to meet the host's, and count host reads.

PyTorch has one device type, PrivateUse1, for external backends. Here it is called `sim`. A wrapper subclass holds
the values in a CPU tensor, and autograd treats it as it treats a tensor of a GPU: with a device of its own, and a
thread of its own for backward passes. Reads that would wait for a GPU (`item`, a boolean index, a copy to the host) are
counted, with file and line of the reader. Import this module before the first backward pass of the process, because
autograd counts devices once.
"""

from __future__ import annotations

import collections
import contextlib
import sys
from collections.abc import Iterator
from typing import Any

import torch
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

aten = torch.ops.aten

# Operations whose result, or its size, must be known on the host before the next line of Python runs.
WAITS = {
    aten._local_scalar_dense.default: "item",
    aten.is_nonzero.default: "bool",
    aten.equal.default: "equal",
    aten.nonzero.default: "nonzero",
    aten.masked_select.default: "masked_select",
    aten._unique2.default: "unique",
    aten.unique_dim.default: "unique",
}
INDEXING = {
    aten.index.Tensor,
    aten._unsafe_index.Tensor,
    aten.index_put.default,
    aten.index_put_.default,
    aten._index_put_impl_.default,
}
JOINING = {aten.stack.default, aten.cat.default}  # elsewhere, scalars of the host are allowed
COPYING = {aten._to_copy.default, aten.copy_.default}


class MixedDevicesError(RuntimeError):
    """An operation was given tensors of both devices, which a GPU refuses."""


class HostReads:
    """Counts the reads for which the host would wait for a GPU.

    Attributes:
        reads: Number of reads, by kind and by file, line and function of the reader: the innermost frame that is
            neither PyTorch's nor this file's.
    """

    def __init__(self) -> None:
        self.reads: collections.Counter[tuple[str, str, int, str]] = collections.Counter()
        self._paused = 0

    def note(self, kind: str) -> None:
        if not self._paused:
            self.reads[(kind, *_asker())] += 1

    def take(self) -> collections.Counter[tuple[str, str, int, str]]:
        """Return the counts so far, and begin anew."""
        taken, self.reads = self.reads, collections.Counter()
        return taken

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """Count nothing: for a stand-in that copies to the host where a CUDA extension would not."""
        self._paused += 1
        try:
            yield
        finally:
            self._paused -= 1


host = HostReads()


def _asker() -> tuple[str, int, str]:
    frame = sys._getframe(2)
    while frame is not None:
        name = frame.f_code.co_filename
        inner = ("/torch/", "/contextlib", "/functools", "/threading", "/device/simulated", "/device/lookalikes_on_sim")
        if not name.startswith("<") and not any(part in name for part in inner):
            return name, frame.f_lineno, frame.f_code.co_name
        frame = frame.f_back  # type: ignore[assignment]
    return "?", 0, "?"


class _Guard(torch._C._acc.DeviceGuard):
    def type_(self) -> Any:
        return torch._C._autograd.DeviceType.PrivateUse1


class _Event:
    """Waits for the work that was launched before `record`, and for no later work."""

    def record(self, stream: Any = None) -> None: ...

    def synchronize(self) -> None:
        host.note("waited for a copy")


class _Backend(_DummyBackendModule):
    Event = _Event

    def get_rng_state(self, device: Any = None) -> torch.Tensor:
        return torch.zeros(1, dtype=torch.uint8)

    def set_rng_state(self, state: torch.Tensor, device: Any = None) -> None: ...

    def synchronize(self, device: Any = None) -> None:
        host.note("synchronize")


_setup_privateuseone_for_python_backend("sim", _Backend())
SIM = torch.device("sim", 0)


class SimTensor(torch.Tensor):
    """A tensor that says it lies on `sim`.

    Attributes:
        elem: Its values, on the CPU.
    """

    elem: torch.Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, elem: torch.Tensor) -> SimTensor:
        place: dict[str, Any] = {}
        if elem.layout is torch.strided:
            place = {"strides": elem.stride(), "storage_offset": elem.storage_offset()}
        made = torch.Tensor._make_wrapper_subclass(
            cls, elem.shape, dtype=elem.dtype, device=SIM, layout=elem.layout, **place
        )
        made.elem = elem
        return made

    def __repr__(self, **_: Any) -> str:
        return f"SimTensor({tuple(self.shape)}, {self.dtype})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def is_sim(device: Any) -> bool:
    """Whether a device, or its name, is the simulated one."""
    return device is not None and torch.device(device).type == "sim"


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Run one operation, some of whose tensors lie on `sim`, or whose result shall."""
    tensors = [leaf for leaf in pytree.tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    on_sim = [one for one in tensors if isinstance(one, SimTensor)]
    on_host = [one for one in tensors if not isinstance(one, SimTensor)]
    _count(func, args, kwargs, on_sim)
    if on_sim and on_host and func not in COPYING:
        _refuse_mixed(func, args, on_host)
    wanted = kwargs.get("device")
    result_on_sim = bool(on_sim) if wanted is None else is_sim(wanted)
    args_, kwargs_ = pytree.tree_map(lambda x: x.elem if isinstance(x, SimTensor) else x, (args, kwargs))
    if is_sim(wanted):
        kwargs_ = {**kwargs_, "device": torch.device("cpu")}
    if kwargs_.get("pin_memory"):
        kwargs_ = {**kwargs_, "pin_memory": False}
    out = func(*args_, **kwargs_)
    if func is aten.copy_.default:
        return args[0]
    if not result_on_sim:
        return out
    changes = any(x.alias_info is not None and x.alias_info.is_write for x in func._schema.arguments)
    if changes and func._schema.name.endswith("_") and isinstance(out, torch.Tensor):
        return args[0]
    out = pytree.tree_map(lambda x: SimTensor(x) if isinstance(x, torch.Tensor) else x, out)
    return return_and_correct_aliasing(func, args, kwargs, out) if changes else out


def _count(func: Any, args: Any, kwargs: dict[str, Any], on_sim: list[SimTensor]) -> None:
    if func in WAITS:
        host.note(WAITS[func])
    elif func in INDEXING:
        if any(isinstance(i, SimTensor) and i.dtype in (torch.bool, torch.uint8) for i in args[1]):
            host.note("boolean index")
    elif func is aten._to_copy.default:
        to = kwargs.get("device")
        if on_sim and to is not None and not is_sim(to) and not kwargs.get("non_blocking"):
            host.note("copy to the host")
    elif func is aten.copy_.default:
        waits = not (len(args) > 2 and args[2]) and not kwargs.get("non_blocking")
        if waits and isinstance(args[1], SimTensor) and not isinstance(args[0], SimTensor):
            host.note("copy to the host")


def _refuse_mixed(func: Any, args: Any, on_host: list[torch.Tensor]) -> None:
    # Scalars and indices may lie on the host.
    wrong = [one for one in on_host if one.dim() > 0]
    if func in INDEXING:
        wrong = [one for one in wrong if one is args[0] or (len(args) > 2 and one is args[2])]
    if wrong or func in JOINING:
        raise MixedDevicesError(f"Expected all tensors to be on one device, but found sim:0 and cpu in {func}.")


class OnSim(TorchDispatchMode):
    """Inside it, `device="sim"` is understood, and host tensors that meet those of `sim` are refused."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        leaves = pytree.tree_leaves((args, kwargs))
        if is_sim(kwargs.get("device")) or any(isinstance(leaf, SimTensor) for leaf in leaves):
            return _run(func, args, kwargs)
        return func(*args, **kwargs)


class ToHost(torch.autograd.Function):
    """Inputs of a stand-in for a CUDA extension; their gradients are on `sim` again."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
        return x.elem.detach().clone() if isinstance(x, SimTensor) else x.clone()

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:
        return SimTensor(gradient.contiguous())


class ToSim(torch.autograd.Function):
    """Outputs of such a stand-in."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
        return SimTensor(x.detach().clone())

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:
        return gradient.elem  # type: ignore[attr-defined, no-any-return]


def to_host(x: Any) -> Any:
    """A tensor of `sim` as one of the host, differentiably; anything else as it is."""
    return ToHost.apply(x) if isinstance(x, SimTensor) else x


def to_sim(x: Any) -> Any:
    """A tensor as one of `sim`, differentiably; anything else as it is."""
    return ToSim.apply(x) if isinstance(x, torch.Tensor) and not isinstance(x, SimTensor) else x
