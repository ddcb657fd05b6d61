"""Run a call right after a module is imported, by whatever code."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

from skipgs_plug.core.hooks import Hooks


def when_imported(hooks: Hooks, name: str, call: Callable[[ModuleType], None]) -> None:
    """Call `call(module)` right after the module of that name is imported, or at once if it is imported already.

    A script may extend `sys.path` before it imports its own modules, so they cannot be imported in advance.

    Args:
        hooks: Hooks of the trainer. The call is removed when the gate detaches.
        name: Full name of the module.
        call: Runs before the importing script binds any name of the module.
    """
    if name in sys.modules:
        call(sys.modules[name])
        return

    def guarded(module: ModuleType) -> None:
        hooks.awaited.discard(f"module {name}")
        with hooks.guarded():
            call(module)

    hooks.awaited.add(f"module {name}")
    finder = _Finder(name, guarded)
    sys.meta_path.insert(0, finder)

    def undo() -> None:
        with contextlib.suppress(ValueError):  # the script removed it itself
            sys.meta_path.remove(finder)

    hooks.on_detach(f"sys.meta_path ({name})", undo)


class _Finder(MetaPathFinder):
    """Lets the other finders find one module, and adds a call to its execution."""

    def __init__(self, name: str, call: Callable[[ModuleType], None]) -> None:
        self._name, self._call = name, call

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != self._name:
            return None
        others = (finder.find_spec(fullname, path, target) for finder in sys.meta_path if finder is not self)
        spec = next((found for found in others if found is not None), None)
        if spec is None or spec.loader is None:
            return spec
        execute = spec.loader.exec_module

        def execute_and_call(module: ModuleType) -> None:
            execute(module)
            self._call(module)

        # The loader belongs to this module alone. It stays in place, since tracebacks ask it for sources.
        setattr(spec.loader, "exec_module", execute_and_call)  # noqa: B010
        return spec
