"""Release of a gate that fails, so that no training is lost to an error of the gate."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType

from skipgs_plug.core import distributed
from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import BrokenTrainingError, GateOrderError, SkipGSError

log = logging.getLogger(__name__)


class Release:
    """Releases the gate after an error, so that training continues without it.

    A refusal is raised while it costs no trained iterations. An error of the training itself is raised at any time, and
    so is every error for which other processes would wait. Any other error releases the gate, with one warning.

    Args:
        enabled: Whether the gate is on. A gate that is off refuses nothing.
        refuses: Returns whether a refusal still costs nothing.

    Attributes:
        reason: The sentence of the warning; None while the gate is attached.
        refuses: The argument.
    """

    def __init__(self, enabled: bool, refuses: Callable[[], bool]) -> None:
        self._enabled = enabled
        self._undo: list[Callable[[], None]] = []
        self.reason: str | None = None
        self.refuses = refuses

    def undoes(self, undo: Callable[[], None]) -> None:
        """Add a function that undoes a part of the attachment when the gate is released."""
        self._undo.append(undo)

    def on_error(self, error: Exception, step: int | None, refuses: bool = True) -> None:
        """Raise an error of the gate's own code, or release the gate.

        Args:
            error: The error.
            step: Present iteration; None if it is not known.
            refuses: Whether the caller may still refuse the run, if that costs nothing.

        Raises:
            Exception: The error, if it is a refusal that costs nothing, if it is an error of the training itself, or if
                other processes would wait for this one.
        """
        if self.reason is not None:
            return
        broken = isinstance(error, (BrokenTrainingError, GateOrderError))
        refusal = isinstance(error, SkipGSError) and refuses and self.refuses()
        if broken or (self._enabled and (refusal or distributed.group_size() > 1)):
            self._take_back()
            raise error
        why = str(error) if isinstance(error, SkipGSError) else f"{type(error).__name__}: {error}"
        where = "" if step is None else f" in iteration {step}"
        log.debug("The error that releases the gate:", exc_info=error)
        self.let_go(f"The gate is released{where}, and training goes on without it, in all its iterations ({why})")

    def let_go(self, reason: str) -> None:
        """Undo the attachment, and warn with the reason, once."""
        if self.reason is None:
            self.reason = reason
            self._take_back()
            caution(reason, stacklevel=3)

    def guarded(self, step: Callable[[], int | None] = lambda: None) -> AbstractContextManager[None]:
        """Return a block of the gate's own code; an error in it releases the gate, and the code after it runs on.

        Args:
            step: Returns the present iteration for the message; called at an error only.
        """
        return _Guard(self, step)

    def _take_back(self) -> None:
        for undo in self._undo:
            undo()


class _Guard:
    """A block of code whose errors go to a `Release`."""

    __slots__ = ("_release", "_step")

    def __init__(self, release: Release, step: Callable[[], int | None]) -> None:
        self._release, self._step = release, step

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> bool:
        if not isinstance(error, Exception):
            return False
        self._release.on_error(error, self._step())
        return True
