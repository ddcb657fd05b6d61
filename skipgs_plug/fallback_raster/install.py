"""Replaces gsplat's rasterizer by the CPU rasterizer, and undoes it."""

from __future__ import annotations

import importlib
from types import ModuleType, TracebackType
from typing import Any

from skipgs_plug.install import install_command

_MODULES = ("gsplat", "gsplat.rendering")
_originals: dict[str, Any] = {}
_open: set[Installation] = set()


class Installation:
    """One call of `install_as_gsplat`; also a context manager that undoes itself."""

    def undo(self) -> None:
        """Restore gsplat's own function, once every other installation is undone too.

        A second call does nothing. A name that other code has replaced since is not changed.
        """
        if self not in _open:
            return
        _open.remove(self)
        if _open:
            return
        from .rasterize import rasterization

        for module in _gsplat_modules():
            original = _originals.pop(module.__name__)
            if module.rasterization is rasterization:
                module.rasterization = original  # type: ignore[attr-defined]

    def __enter__(self) -> Installation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.undo()


def install_as_gsplat() -> Installation:
    """Make code written for gsplat's `rasterization` run on the CPU.

    Replaces `gsplat.rasterization` and `gsplat.rendering.rasterization`. Call this first: a module that has already
    executed `from gsplat import rasterization` keeps gsplat's function. Several installations may be active. gsplat's
    function returns when the last of them is undone.

        install_as_gsplat()  # for the rest of the process

        with install_as_gsplat():  # or for a while
            image, alpha, info = gsplat.rasterization(...)

    Returns:
        A handle with `undo()`, which is also a context manager.

    Raises:
        ImportError: gsplat is not installed.

    Examples:
        >>> import gsplat
        >>> from skipgs_plug.fallback_raster import install_as_gsplat, rasterization
        >>> with install_as_gsplat():
        ...     gsplat.rasterization is rasterization
        True
    """
    from .rasterize import rasterization

    modules = _gsplat_modules()
    installation = Installation()
    _open.add(installation)
    for module in modules:
        _originals.setdefault(module.__name__, module.rasterization)
        module.rasterization = rasterization  # type: ignore[attr-defined]
    return installation


def _gsplat_modules() -> list[ModuleType]:
    try:
        return [importlib.import_module(name) for name in _MODULES]
    except ImportError as error:
        raise ImportError(f"install_as_gsplat needs gsplat: {install_command()}.") from error
