"""The registry of adapters, and the choice of the adapter for a trainer."""

from __future__ import annotations

import ast
import importlib
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.loop_code import LOOP, LoopCode
from skipgs_plug.core.errors import AdapterMismatchError, SkipGSError, UnknownTrainerError

# In the order in which they are tried: a fork stands before its parent. Modules are imported when they are tried.
BUILTIN = {
    "reference": "skipgs_plug.adapters.reference_trainer:ReferenceTrainer",
    "gsplat": "skipgs_plug.adapters.gsplat_runner:GsplatRunner",
    "step_trainer": "skipgs_plug.adapters.step_trainer:StepTrainer",
    "nerfstudio": "skipgs_plug.adapters.nerfstudio:Nerfstudio",
    "litegs": "skipgs_plug.adapters.litegs:LiteGS",
    "faster_gs": "skipgs_plug.adapters.faster_gs:FasterGS",
    "edgs": "skipgs_plug.adapters.edgs:EDGS",
    "3dgrut": "skipgs_plug.adapters.threedgrut:ThreeDGRUT",
    "fvdb": "skipgs_plug.adapters.fvdb:FVDB",
    "fastgs": "skipgs_plug.adapters.fastgs:FastGS",
    "taming": "skipgs_plug.adapters.taming:Taming",
    "speedy_splat": "skipgs_plug.adapters.speedy_splat:SpeedySplat",
    "lightgaussian": "skipgs_plug.adapters.lightgaussian:LightGaussian",
    "gaussianspa": "skipgs_plug.adapters.gaussianspa:GaussianSpa",
    "mcmc": "skipgs_plug.adapters.mcmc:MCMC",
    "mini_splatting2": "skipgs_plug.adapters.mini_splatting2:MiniSplatting2",
    "mini_splatting": "skipgs_plug.adapters.mini_splatting:MiniSplatting",
    "perceptual_gs": "skipgs_plug.adapters.perceptual_gs:PerceptualGS",
    "pgsr": "skipgs_plug.adapters.pgsr:PGSR",
    "gof": "skipgs_plug.adapters.gof:GOF",
    "mip_splatting": "skipgs_plug.adapters.mip_splatting:MipSplatting",
    "absgs": "skipgs_plug.adapters.absgs:AbsGS",
    "pixel_gs": "skipgs_plug.adapters.pixel_gs:PixelGS",
    "2dgs": "skipgs_plug.adapters.two_d_gs:TwoDGS",
    "octree_gs": "skipgs_plug.adapters.octree_gs:OctreeGS",
    "scaffold_gs": "skipgs_plug.adapters.scaffold_gs:ScaffoldGS",
    "dash_gaussian": "skipgs_plug.adapters.dash_gaussian:DashGaussian",
    "gns": "skipgs_plug.adapters.gns:GNS",
    "improved_gs": "skipgs_plug.adapters.improved_gs:ImprovedGS",
    "deformable": "skipgs_plug.adapters.deformable:Deformable",
    "inria": "skipgs_plug.adapters.inria:Inria",
}

SHOWN = 6  # functions of an unknown script that the error names, at most: it stays one sentence
SCRIPT_NAME = re.compile(r"(?<![\w./-])[\w./-]+\.py\b")  # from the first letter on: texts can be megabytes long

_registered: dict[str, type[AbstractAdapter]] = {}


def register_adapter(adapter: type[AbstractAdapter]) -> type[AbstractAdapter]:
    """Add an adapter of your own, as a class decorator. It is tried before the built-in adapters.

    Raises:
        SkipGSError: It has no name, or the name is taken.

    Example:
        An adapter for a fork whose training script has a function `refine_all`. It iterates as Inria's does.

        >>> from skipgs_plug.adapters.inria import Inria
        >>> @register_adapter
        ... class MyFork(Inria):
        ...     name = "my_fork"
        ...     mark = "refine_all"
        ...     checked = "my_fork at 1a2b3c4 (trained)"
        >>> adapter_names()[0]
        'my_fork'
    """
    name = getattr(adapter, "name", None)
    if not name or not getattr(adapter, "checked", None):
        raise SkipGSError(f"{adapter.__name__} needs the class attributes name and checked.")
    if name in BUILTIN or _registered.get(name, adapter) is not adapter:
        raise SkipGSError(f"There is an adapter {name!r} already; choose another name.")
    _registered[name] = adapter
    return adapter


def adapter_names() -> list[str]:
    """Return the names of all adapters, with the users' own first."""
    return [*_registered, *BUILTIN]


def get_adapter(name: str) -> type[AbstractAdapter]:
    """Return the adapter class with that name.

    Raises:
        UnknownTrainerError: No adapter has that name.
    """
    if name in _registered:
        return _registered[name]
    if name not in BUILTIN:
        raise UnknownTrainerError(
            f"There is no adapter {name!r}; there are {', '.join(adapter_names())}. "
            "Any other loop can be gated by hand: SkipGate(start_iter=...) and gate.backward(loss, view, step)."
        )
    return _load(BUILTIN[name])


def builtin_adapters() -> Iterator[type[AbstractAdapter]]:
    """Return the adapters of this package, in the order in which they are tried."""
    return map(_load, BUILTIN.values())


def find_adapter(trainer: Any, name: str | None = None) -> AbstractAdapter:
    """Return the adapter for a trainer, by name or by trying all in order.

    Args:
        trainer: An object, a module or a function; None for a script.
        name: Name of the adapter; None to try all.

    Raises:
        UnknownTrainerError: No adapter knows it.
    """
    if name is not None:
        return get_adapter(name)(trainer)
    for candidate in adapter_names():
        adapter = get_adapter(candidate)
        if adapter.matches(trainer):
            return adapter(trainer)
    raise UnknownTrainerError(
        f"No adapter knows {_describe(trainer)}; there are {', '.join(adapter_names())} (adapter=NAME). "
        "Any other loop can be gated by hand: SkipGate(start_iter=...) and gate.backward(loss, view, step)."
    )


def find_script_adapter(script: Path) -> type[AbstractAdapter]:
    """Return the adapter for a training script, by the names in its source. The script does not run.

    Raises:
        UnknownTrainerError: No adapter knows it.
    """
    code = LoopCode.of_script(script)
    if (adapter := _recognising(code)) is not None:
        return adapter
    if not code.calls_backward and (started := _training_scripts_named_in(script)):
        names = _listed(started)
        raise UnknownTrainerError(
            f"{script} holds no training loop, but names {names}, which no gate reaches in a process of its own: run "
            f"it with --no-gate if it does not train, start skipgs-plug run ADAPTER -- {started[0]} yourself, or write "
            f"skipgs-plug run ADAPTER -- in place of python in a copy of {script.name}."
        )
    advice = "gate that loop"
    if code.used:
        found, advice = "a function training(), but no GaussianModel", "gate its loop"
    elif code.backward:
        found = f"no function training(), but calls backward in {_listed(code.backward)}"
    elif code.calls_backward:
        found = "no function training(), but calls backward itself"
    elif LOOP in code.functions:
        found = f"a function {LOOP}() without a training loop"
        advice = "run it with --no-gate if it does not train, name the script that holds the loop, gate that loop"
    else:
        functions = [name for name in code.functions if not name.startswith("_")]
        found = f"no function training(), but {_listed(functions)}" if functions else "no function at all"
        named = "name the script that holds the training loop"
        advice = f"run it with --no-gate if it does not train, {named}, gate that loop"
    raise UnknownTrainerError(
        f"No adapter knows {script}, which has {found}: {advice} by hand with SkipGate(start_iter=...) and "
        "gate.backward(loss, view, step), as in docs/gate.md, or write an adapter (CONTRIBUTING.md)."
    )


def _recognising(code: LoopCode) -> type[AbstractAdapter] | None:
    """Return the first adapter that recognises a script."""
    adapters = map(get_adapter, adapter_names())
    return next((adapter for adapter in adapters if adapter.recognises_script(code)), None)


def _training_scripts_named_in(driver: Path) -> list[str]:
    """Return the training scripts whose files a script names in its texts, as one does that starts them.

    Docstrings are left out, because they also name scripts that came before.
    """
    nodes = list(ast.walk(ast.parse(driver.read_bytes())))
    docstrings = {node.value for node in nodes if isinstance(node, ast.Expr)}
    texts = [node.value for node in nodes if isinstance(node, ast.Constant) and node not in docstrings]
    words = {word for text in texts if isinstance(text, str) for word in SCRIPT_NAME.findall(text)}
    return sorted(word for word in words if _is_training_script(word, driver))


def _is_training_script(word: str, driver: Path) -> bool:
    # Not Path.is_file, which raises for a folder that may not be read, and for a name that is too long.
    file = next((path for path in (Path(word), driver.parent / word) if os.path.isfile(path)), None)
    return file is not None and not file.samefile(driver) and _adapter_of(file) is not None


def _adapter_of(file: Path) -> type[AbstractAdapter] | None:
    try:
        return _recognising(LoopCode.of_script(file))
    except (AdapterMismatchError, OSError):  # it is not Python, or cannot be read
        return None


def find_adapter_beside(script: Path) -> type[AbstractAdapter] | None:
    """Return the adapter of the trainer to which a script without a training loop belongs, such as its render.py.

    It is the adapter of train.py in the same folder, or else of all training scripts there; None if they have several.
    """
    trains = script.with_name("train.py")
    found = {_adapter_of(file) for file in ([trains] if trains.is_file() else script.parent.glob("*.py"))} - {None}
    return found.pop() if len(found) == 1 else None


def _listed(names: Iterable[str]) -> str:
    """Return the first of the names, in one line."""
    first, more = sorted(names)[:SHOWN], sorted(names)[SHOWN:]
    return f"{', '.join(first)}{' ...' if more else ''}"


def _load(path: str) -> type[AbstractAdapter]:
    module, _, attribute = path.partition(":")
    return getattr(importlib.import_module(module), attribute)


def _describe(trainer: Any) -> str:
    name = getattr(trainer, "__name__", None)
    return f"{name!r}" if name else f"a {type(trainer).__module__}.{type(trainer).__qualname__}"
