"""C++ kernels, compiled and loaded by Warp.

Warp brings a Clang of its own, so no compiler has to be installed. Compiled kernels are cached on disk.
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

from .cache import in_temporary_folder, load_or_rebuild


class Kernel(NamedTuple):
    """A loaded kernel. `kernel(kernel.pack(*values))` runs it on the calling thread, without the interpreter lock."""

    run: Callable[..., None]
    bounds: Any
    pack: Callable[..., bytes]  # makes the structure of arguments from their values, in order
    addresses: tuple[int, int]  # addresses of the function and of the bounds
    command: Any  # Warp's command, which keeps the code loaded while it lives

    def __call__(self, arguments: bytes) -> None:
        """Run the kernel with packed arguments. It only reads them."""
        self.run(self.bounds, arguments)  # ctypes passes the address of the bytes


def load_kernel(name: str, parameters: dict[str, str], code: str) -> Kernel:
    """Load a kernel from the cache, or compile it.

    Args:
        name: Name of the kernel in files and messages.
        parameters: Warp's type of each parameter, by the name that `code` uses.
        code: The body of a C++ function.

    Raises:
        ImportError: Warp is not installed.
        WriteError: The kernel has to be compiled, but neither the cache nor a temporary folder can be written.
    """
    wp = _warp()
    signature = ", ".join(f"{parameter}: {kind}" for parameter, kind in parameters.items())
    source = f"def {name}_body({signature}): ...\n"
    source += f"def {name}({signature}):\n    {name}_body({', '.join(parameters)})\n"
    # Warp reads a kernel's source through `inspect`, which finds generated code in `linecache`.
    filename = f"<skipgs_plug {name}>"
    linecache.cache[filename] = (len(source), None, source.splitlines(keepends=True), filename)
    namespace: dict[str, Any] = {"wp": wp, "__name__": f"{__package__}.{name}"}
    exec(compile(source, filename, "exec"), namespace)
    body = namespace[f"{name}_body"]
    namespace[f"{name}_body"] = wp.func_native(code)(body)
    kernel = wp.kernel(enable_backward=False)(namespace[name])
    inputs = [0] * len(parameters)

    def load() -> Any:
        return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True, record_tape=False)

    def load_from_cache() -> Any:
        # Warp's module identifier depends on the number of threads per block, which is 1 on the CPU.
        folder = Path(wp.config.kernel_cache_dir) / kernel.module.get_module_identifier(1)
        return load_or_rebuild(folder, load, kernel.module.unload)

    try:
        command = load_from_cache()
    except OSError as error:
        in_temporary_folder(wp, error)
        kernel.module.unload()
        command = load_from_cache()
    bounds, *values = command.params
    pack = _packer(f"{name}_arguments", dict(zip(parameters, map(type, values), strict=True)))
    run = command.hooks.forward
    addresses = ctypes.cast(run, ctypes.c_void_p).value or 0, ctypes.addressof(bounds)
    return Kernel(run, ctypes.byref(bounds), pack, addresses, command)


def _packer(name: str, kinds: dict[str, Any]) -> Callable[..., bytes]:
    """Return a function that makes the bytes of a structure from its values. `kinds` are ctypes' types by name."""
    structure = type(name, (ctypes.Structure,), {"_fields_": list(kinds.items())})
    # ctypes sets fields one by one, by name, which is slow.
    layout = struct.Struct("".join(kind._type_ for kind in kinds.values()))

    def pack(*values: int | float) -> bytes:
        try:
            return layout.pack(*values)
        except OverflowError:  # a value beyond float32, which ctypes makes infinite
            return bytes(structure(*values))

    return pack


# Kernels load on several threads at once. Two threads that start Warp at the same time would make it two runtimes. The
# second would keep its kernels in a folder inside the first one's, where no later process looks.
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
    try:
        with _quiet_stderr():
            wp.init()
    except OSError as error:
        in_temporary_folder(wp, error)
        with _quiet_stderr():
            wp.init()
    return wp


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Discard output of native code to stderr inside the `with` statement.

    Warp's library warns there that it found no CUDA driver, which is normal for this rasterizer.
    """
    try:
        kept = os.dup(2)
    except OSError:  # stderr is closed, as in programs without a console on Windows: there is nothing to discard
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
