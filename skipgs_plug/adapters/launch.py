"""Run a training script as Python itself would, in this process, so that adapters can reach into it."""

from __future__ import annotations

import functools
import importlib.util
import runpy
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from skipgs_plug.core.errors import SkipGSError


def run_script(command: Sequence[str], attach: Callable[[], None] | None = None) -> int:
    """Execute an unmodified script in its own checkout and give its exit code.

    The script sees its own folder first on `sys.path`, its own `sys.argv`, and `__name__ == "__main__"`.
    Output, files and traceback are its own. The working folder stays as it is.

    Args:
        command: What would follow `python`: a script and its arguments, or `-m`, a module and its arguments.
        attach: Called where the script would be: its folder is on `sys.path`, nothing of it is imported.

    Raises:
        SkipGSError: There is no such script or module, or a module of the script's checkout was imported
            before from somewhere else.
    """
    script, arguments, run = _resolve(command)
    first_on_path = Path.cwd() if command[0] == "-m" else script.parent
    with _as_main_program(script, arguments, first_on_path), _whole_checkpoints():
        if attach is not None:
            attach()
        try:
            run()
        except SystemExit as stop:
            return _exit_code(stop.code)
        except SkipGSError:
            raise
        except BaseException as error:
            _print_traceback(error, script)
            return 130 if isinstance(error, KeyboardInterrupt) else 1
    return 0


def _resolve(command: Sequence[str]) -> tuple[Path, Sequence[str], Callable[[], Any]]:
    if not command or list(command) == ["-m"]:
        raise SkipGSError("There is no script to run: name it after '--', for example -- train.py -s data.")
    if command[0] == "-m":
        name = command[1]
        try:
            found = importlib.util.find_spec(name)
        except ModuleNotFoundError:  # its package is not there either
            found = None
        if found is None or found.origin is None:
            raise SkipGSError(f"There is no module {name}: install it, or name a training script after '--'.")
        run = functools.partial(runpy.run_module, name, run_name="__main__")
        return Path(found.origin).resolve(), command[2:], run
    script = Path(command[0]).resolve()
    if not script.is_file():
        raise SkipGSError(f"There is no script {script}: name the training script after '--'.")
    _refuse_shadowed_modules(script.parent)
    return script, command[1:], functools.partial(runpy.run_path, str(script), run_name="__main__")


def _exit_code(code: Any) -> int:
    if code is None or isinstance(code, int):
        return code or 0
    print(code, file=sys.stderr)
    return 1


def _print_traceback(error: BaseException, script: Path) -> None:
    """As the interpreter prints it: from the script's own first frame on."""
    trace = error.__traceback__
    while trace is not None and trace.tb_frame.f_code.co_filename != str(script):
        trace = trace.tb_next
    traceback.print_exception(type(error), error, trace or error.__traceback__)


def _refuse_shadowed_modules(checkout: Path) -> None:
    own = {entry.stem for entry in checkout.iterdir() if entry.suffix == ".py" or (entry / "__init__.py").is_file()}
    for name in sorted(own & set(sys.modules)):
        origin = getattr(sys.modules[name], "__file__", None)
        if origin and checkout not in Path(origin).resolve().parents:
            raise SkipGSError(
                f"The script's module {name!r} was already imported from {origin}: run one training script per process."
            )


@contextmanager
def _as_main_program(script: Path, arguments: Sequence[str], first_on_path: Path) -> Iterator[None]:
    argv, path, stdout = sys.argv, list(sys.path), sys.stdout
    sys.argv = [str(script), *arguments]
    sys.path.insert(0, str(first_on_path))
    try:
        yield
    finally:
        sys.argv, sys.path[:], sys.stdout = argv, path, stdout


@contextmanager
def _whole_checkpoints() -> Iterator[None]:
    """Let `torch.load` read checkpoints as it did before PyTorch 2.6.

    The trainers save NumPy scalars beside their tensors, which the newer default refuses to load.
    """
    load = torch.load

    @functools.wraps(load)
    def load_whole(*args: Any, **kwargs: Any) -> Any:
        if kwargs.get("weights_only") is None:
            kwargs["weights_only"] = False
        return load(*args, **kwargs)

    torch.load = load_whole
    try:
        yield
    finally:
        torch.load = load
