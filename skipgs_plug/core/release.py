"""The one place where a gate gives up: no run is lost to it."""

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
    """Lets go of a training that continues without a gate.

    A refusal is raised as long as it costs nothing. An error of the training itself is raised at any time, and so is
    every error where other processes would wait for this one. Any other error releases the gate, with one warning.

    Args:
        enabled: Whether the gate is on. One that is off has refused nothing and ends nothing.
        refuses: Says whether a refusal still costs nothing.

    Attributes:
        reason: Sentence that was said; None while the gate holds on.
        refuses: As given.
    """

    def __init__(self, enabled: bool, refuses: Callable[[], bool]) -> None:
        self._enabled = enabled
        self._undo: list[Callable[[], None]] = []
        self.reason: str | None = None
        self.refuses = refuses

    def undoes(self, undo: Callable[[], None]) -> None:
        """Have something taken back whenever the gate gives up."""
        self._undo.append(undo)

    def on_error(self, error: Exception, step: int | None, refuses: bool | None = None) -> None:
        """Raise an error of the gate's own code, or let go.

        Args:
            error: That was raised.
            step: Present iteration, if it is known.
            refuses: Whether a refusal costs nothing, where the caller knows better than `refuses`.

        Raises:
            Exception: The error, if it is a refusal that costs nothing, is of the training itself, or if other
                processes would wait for this one.
        """
        if self.reason is not None:
            return
        broken = isinstance(error, (BrokenTrainingError, GateOrderError))
        refusal = isinstance(error, SkipGSError) and (self.refuses() if refuses is None else refuses)
        if broken or (self._enabled and (refusal or distributed.group_size() > 1)):
            self._take_back()
            raise error
        why = str(error) if isinstance(error, SkipGSError) else f"{type(error).__name__}: {error}"
        where = "" if step is None else f" in iteration {step}"
        log.debug("The error that releases the gate:", exc_info=error)
        self.let_go(f"The gate is released{where}, and training goes on without it, in all its iterations ({why})")

    def let_go(self, reason: str) -> None:
        """Take everything back, and say why, once."""
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
    """A block of code whose errors are told to a `Release`."""

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
