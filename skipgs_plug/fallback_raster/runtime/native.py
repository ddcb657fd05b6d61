"""Kernels of C++, compiled and loaded by Warp.

Warp brings a Clang of its own, so no compiler has to be installed. Kernels are cached on disk.
"""

import ctypes
import functools
import importlib
import linecache
import os
import struct
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from skipgs_plug.install import install_command

from .cache import load_or_rebuild, say_unwritable


class Kernel(NamedTuple):
    """A loaded kernel: `kernel(kernel.pack(*values))` runs it on this thread, without the interpreter lock."""

    run: Callable[..., None]
    bounds: Any
    pack: Callable[..., bytes]  # makes the structure of its arguments, from these in their order
    addresses: tuple[int, int]  # of the function and of the bounds
    command: Any  # of Warp; the code stays loaded as long as it lives

    def __call__(self, arguments: bytes) -> None:
        """Run it with these arguments, which it reads only."""
        self.run(self.bounds, arguments)  # ctypes passes the address of the bytes


def load_kernel(name: str, parameters: dict[str, str], code: str) -> Kernel:
    """Compile a kernel, or take it from the cache.

    Args:
        name: Its name in files and messages.
        parameters: Warp's types by name, which `code` knows them by.
        code: The body of a C++ function.

    Raises:
        ImportError: Warp is not installed.
    """
    wp = _warp()
    signature = ", ".join(f"{parameter}: {kind}" for parameter, kind in parameters.items())
    source = f"def {name}_body({signature}): ...\n"
    source += f"def {name}({signature}):\n    {name}_body({', '.join(parameters)})\n"
    # Warp reads a kernel's source back through `inspect`, which finds generated code in `linecache`.
    filename = f"<skipgs_plug {name}>"
    linecache.cache[filename] = (len(source), None, source.splitlines(keepends=True), filename)
    namespace: dict[str, Any] = {"wp": wp, "__name__": f"{__package__}.{name}"}
    exec(compile(source, filename, "exec"), namespace)
    body = namespace[f"{name}_body"]
    namespace[f"{name}_body"] = wp.func_native(code)(body)
    kernel = wp.kernel(enable_backward=False)(namespace[name])
    inputs = [0] * len(parameters)
    # Warp compiles for blocks of one thread on the CPU.
    folder = Path(wp.config.kernel_cache_dir) / kernel.module.get_module_identifier(1)

    def load() -> Any:
        with say_unwritable():
            return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True, record_tape=False)

    command = load_or_rebuild(folder, load, kernel.module.unload)
    bounds, *values = command.params
    pack = _packer(f"{name}_arguments", dict(zip(parameters, map(type, values), strict=True)))
    run = command.hooks.forward
    addresses = ctypes.cast(run, ctypes.c_void_p).value or 0, ctypes.addressof(bounds)
    return Kernel(run, ctypes.byref(bounds), pack, addresses, command)


def _packer(name: str, kinds: dict[str, Any]) -> Callable[..., bytes]:
    """Makes structures of these fields, of the simple types of ctypes, from their values."""
    structure = type(name, (ctypes.Structure,), {"_fields_": list(kinds.items())})
    # ctypes looks for the names of fields one by one, far from the caches.
    layout = struct.Struct("".join(kind._type_ for kind in kinds.values()))

    def pack(*values: int | float) -> bytes:
        try:
            return layout.pack(*values)
        except OverflowError:  # beyond float32, which is infinite to ctypes
            return bytes(structure(*values))

    return pack


# Kernels load on several threads at once. Two threads that start Warp together make it two runtimes, and the second one
# keeps its kernels in a folder inside the first one's, where no later process looks for them.
_starting = threading.Lock()


def _warp() -> Any:
    with _starting:
        return _started_warp()


@functools.cache
def _started_warp() -> Any:
    try:
        wp: Any = importlib.import_module("warp")
    except ImportError as error:
        raise ImportError(f"The CPU rasterizer needs NVIDIA Warp: {install_command()}.") from error
    wp.config.quiet = True
    wp.config.log_level = wp.LOG_ERROR
    with _quiet_stderr(), say_unwritable():
        wp.init()
    return wp


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Drops what native code writes to stderr inside the block.

    Warp's library warns there that it found no CUDA driver, which a rasterizer for machines without one expects.
    """
    try:
        kept = os.dup(2)
    except OSError:  # closed, as of programs without a window on Windows: nothing to drop
        yield
        return
    if sys.stderr is not None:
        sys.stderr.flush()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
