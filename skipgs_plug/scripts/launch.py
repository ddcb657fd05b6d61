"""Run a training script in this process, as Python would run it, so that adapters can change it."""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import itertools
import runpy
import sys
import types
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, NamedTuple

import torch

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.messages import say
from skipgs_plug.scripts.import_hints import install_hint
from skipgs_plug.scripts.stand_in_hints import stand_in_hint
from skipgs_plug.scripts.wrappers import program_hint, wrapper_hint

PACKAGE = Path(__file__).parents[1]
Attach = Callable[[], dict[str, Any]]  # see `run_script`


def run_script(
    command: Sequence[str], attach: Attach | None = None, on_cpu: bool = False, stand_ins: Container[str] = ()
) -> int:
    """Run an unmodified script in its own checkout and return its exit code.

    The script finds its own folder first on `sys.path`, its own `sys.argv`, and `__name__ == "__main__"`. Its output,
    files and traceback look as if Python ran it. The working folder does not change.

    Args:
        command: The arguments of `python`: a script and its arguments, or `-m`, a module and its arguments. Also a
            command that an installed package provides, such as `ns-train`, and its arguments.
        attach: Called immediately before the script runs, when its folder is on `sys.path` and none of its modules is
            imported. Returns names to add to the script's globals.
        on_cpu: Whether CPU stand-ins replace CUDA modules. Error messages depend on it.
        stand_ins: Modules that `--cpu` replaces for this trainer. Error messages depend on them.

    Raises:
        SkipGSError: The script or module does not exist, or a module of the script's checkout was already imported
            from another folder.
    """
    return _run(_resolve(command), attach, None, on_cpu, stand_ins)


def run_in_script(
    command: Sequence[str], attach: Attach, run: Callable[[str, dict[str, Any]], None], on_cpu: bool
) -> int:
    """Like `run_script`, but call `run(file, names)` instead of running the script."""
    return _run(_resolve(command), attach, run, on_cpu, ())


def _run(
    program: _Program,
    attach: Attach | None,
    instead: Callable[[str, dict[str, Any]], None] | None,
    on_cpu: bool,
    stand_ins: Container[str],
) -> int:
    with _as_main_program(program), _known_to_processes(), _whole_checkpoints():
        try:
            names = {} if attach is None else attach()
            if instead is None:
                program.run(names)
            else:
                instead(str(program.source), names)
        except SystemExit as stop:
            return _exit_code(stop.code)
        except SkipGSError:
            raise
        except BaseException as error:
            if on_cpu and (sentence := stand_in_hint(error)):
                say(sentence)
                return 1
            _print_traceback(error, program)
            if isinstance(error, ModuleNotFoundError) and error.name:
                say(install_hint(error.name, program.source, stand_ins))
            return 130 if isinstance(error, KeyboardInterrupt) else 1
    return 0


def source_of(command: Sequence[str]) -> Path:
    """Return the file that `run_script` would run for this command.

    Raises:
        SkipGSError: The script or module does not exist, or a module of the script's checkout was already imported
            from another folder.
    """
    return _resolve(command).source


class _Program(NamedTuple):
    argv: list[str]
    folder: Path  # first on sys.path
    source: Path  # file of the script; the traceback begins with its frames
    run: Callable[[dict[str, Any]], Any]  # called with names to add to the script's globals


def _resolve(command: Sequence[str]) -> _Program:
    if not command or list(command) == ["-m"]:
        raise SkipGSError("There is no script to run: name it after '--', for example -- train.py -s data.")
    name, arguments = command[0], list(command[1:])
    if name == "-m":
        name, *arguments = arguments
        with _first_on_path(Path.cwd()):
            source = _source_of(f"{name}.__main__") or _source_of(name)  # of a package, Python runs `__main__`
        if source is None:
            raise SkipGSError(f"There is no module {name}: install it, or name a training script after '--'.")
        run = functools.partial(_run_module, name)
        return _Program([str(source), *arguments], Path.cwd(), source, run)
    if (instead := wrapper_hint(name)) is not None:
        raise SkipGSError(instead)
    script = Path(name).resolve()
    commands = Path(sys.executable).parent  # folder of the commands that installed packages provide
    if script.is_file() and not (script.parent == commands.resolve() and _provided(script.name)):
        _refuse_shadowed_modules(script.parent)
        run = functools.partial(_run_path, str(script))
        return _Program([str(script), *arguments], script.parent, script, run)
    if (installed := _provided(script.name if script.is_file() else name)) is not None:
        file = commands / installed.name
        module = _source_of(installed.module) or file
        return _Program([str(file), *arguments], commands, module, functools.partial(_call, installed))
    if script.is_dir():
        raise SkipGSError(f"{script} is a folder: name the training script in it after '--'.")
    if (instead := program_hint(name)) is not None:
        raise SkipGSError(instead)
    raise SkipGSError(f"There is no script {script}: name the training script after '--'.")


def _run_module(name: str, names: dict[str, Any]) -> None:
    # As `__main__` in sys.modules, too: type hints and pickles of the script's classes are looked up there.
    runpy.run_module(name, init_globals=names, run_name="__main__", alter_sys=True)


def _run_path(script: str, names: dict[str, Any]) -> None:
    runpy.run_path(script, init_globals=names, run_name="__main__")


def _provided(name: str) -> importlib.metadata.EntryPoint | None:
    """Return the command of this name that an installed package provides."""
    return next(iter(importlib.metadata.entry_points(group="console_scripts", name=name)), None)


def _call(installed: importlib.metadata.EntryPoint, names: dict[str, Any]) -> None:
    function = installed.load()
    vars(sys.modules[installed.module]).update(names)
    sys.exit(function())


def _source_of(module: str) -> Path | None:
    """Return the file of a module, without importing it or its packages: those may need the stand-ins of `--cpu`."""
    top, *inner = module.split(".")
    found = importlib.util.find_spec(top)
    for name in inner:
        if found is None:
            return None
        places = found.submodule_search_locations
        # The name alone: with those of its packages, namespace packages must have been imported.
        found = None if places is None else PathFinder.find_spec(name, list(places))
    return None if found is None or found.origin is None else Path(found.origin).resolve()


def _exit_code(code: Any) -> int:
    if code is None or isinstance(code, int):
        return code or 0
    print(code, file=sys.stderr)
    return 1


def _print_traceback(error: BaseException, program: _Program) -> None:
    """Print the traceback from the first frame of the script or its checkout on, without wrappers of its functions."""

    def is_ours(trace: types.TracebackType) -> bool:
        file = trace.tb_frame.f_code.co_filename
        return file != str(program.source) and program.folder not in Path(file).parents

    trace = error.__traceback__
    while trace is not None and is_ours(trace):
        trace = trace.tb_next
    shown = error.with_traceback(_without_wrappers(trace or error.__traceback__))
    sys.excepthook(type(shown), shown, shown.__traceback__)  # the script may have set its own


def _without_wrappers(trace: types.TracebackType | None) -> types.TracebackType | None:
    """Leave out the frames of this package that call other code. If the error is its own, the last frames show it."""
    frames = []
    while trace is not None:
        frames.append(trace)
        trace = trace.tb_next
    own = [PACKAGE in Path(one.tb_frame.f_code.co_filename).parents for one in frames]
    last = max((place for place, is_own in enumerate(own) if not is_own), default=-1)
    kept = [one for place, one in enumerate(frames) if not own[place] or place > last]
    for one, following in itertools.pairwise(kept):
        one.tb_next = following
    return kept[0] if kept else None


def _refuse_shadowed_modules(checkout: Path) -> None:
    own = {entry.stem for entry in checkout.iterdir() if entry.suffix == ".py" or (entry / "__init__.py").is_file()}
    for name in sorted(own & set(sys.modules)):
        origin = getattr(sys.modules[name], "__file__", None)
        if origin and checkout not in Path(origin).resolve().parents:
            raise SkipGSError(
                f"The script's module {name!r} was already imported from {origin}: run one training script per "
                "process, or rename this module if it is a library's."
            )


@contextmanager
def _as_main_program(program: _Program) -> Iterator[None]:
    argv, stdout = sys.argv, sys.stdout
    sys.argv = program.argv
    try:
        with _first_on_path(program.folder):
            yield
    finally:
        sys.argv, sys.stdout = argv, stdout


@contextmanager
def _known_to_processes() -> Iterator[None]:
    """Let the script take objects of its own classes from processes that it spawned.

    These processes call the script `__mp_main__`. In this process, that name would mean skipgs-plug's own main module.
    """
    script = types.ModuleType("__mp_main__")
    vars(script)["__getattr__"] = lambda name: getattr(sys.modules["__main__"], name)
    before = sys.modules["__mp_main__"]
    sys.modules["__mp_main__"] = script
    try:
        yield
    finally:
        sys.modules["__mp_main__"] = before


@contextmanager
def _first_on_path(folder: Path) -> Iterator[None]:
    path = list(sys.path)
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path[:] = path


@contextmanager
def _whole_checkpoints() -> Iterator[None]:
    """Let `torch.load` read checkpoints as it did before PyTorch 2.6.

    The trainers save NumPy scalars with their tensors. Newer versions of PyTorch refuse to load them by default.
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
