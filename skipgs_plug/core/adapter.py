"""What the gate asks of an adapter, and where it finds one. Adapters themselves live elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import torch

from skipgs_plug.core.errors import UnknownTrainerError

if TYPE_CHECKING:
    from skipgs_plug.core.hooks import Hooks


class Adapter(Protocol):
    """One trainer's answers; see `skipgs_plug.adapters.base` for their meaning."""

    name: ClassVar[str]
    checked: ClassVar[str]

    def attach(self, hooks: Hooks) -> None: ...

    def attach_script(self, hooks: Hooks) -> None: ...

    def must_run(self, step: int) -> bool: ...

    def optimizers(self) -> Iterable[torch.optim.Optimizer]: ...

    def timing(self) -> tuple[float, float] | None: ...


Finder = Callable[[Any, "str | None"], Adapter]

_finder: Finder | None = None


def use_finder(finder: Finder) -> None:
    """Let `find` ask this function; the registry of adapters calls it once."""
    global _finder
    _finder = finder


def find(trainer: Any, name: str | None) -> Adapter:
    """Return the adapter for a trainer, or the one of that name.

    Raises:
        UnknownTrainerError: There is none.
    """
    if _finder is None:
        raise UnknownTrainerError("No adapters are registered; import skipgs_plug.adapters first.")
    return _finder(trainer, name)
