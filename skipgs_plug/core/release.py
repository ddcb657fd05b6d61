"""Release of a gate that fails, so that no training is lost to an error of the gate."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType

import torch

from skipgs_plug.core import decision, distributed
from skipgs_plug.core.caution import caution, cautioned
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.errors import BrokenTrainingError, DivergedError, GateOrderError, SkipGSError

log = logging.getLogger(__name__)


class Release:
    """Releases the gate after an error, so that training continues without it.

    A refusal is raised while it costs no trained iterations. An error of the training itself is raised at any time. Any
    other error releases the gate, with one warning.

    Processes that train together must all skip a backward pass or none, and leave out the same iterations. Their gates
    are released together: if all meet an error in the same iteration, or if one tells the others in a vote. An error
    of which the others do not hear is raised.

    Args:
        enabled: Whether the gate is on. A gate that is off refuses nothing.
        refuses: Returns whether a refusal still costs nothing.

    Attributes:
        reason: The sentence of the warning; None while the gate is attached.
        refuses: The argument.
        in_script: Whether the trainer is a script, whose user has no gate to call.
        attached: Whether an adapter attached the gate to a trainer. Otherwise the loop is the user's own.
    """

    def __init__(self, enabled: bool, refuses: Callable[[], bool]) -> None:
        self._enabled = enabled
        self._undo: list[Callable[[], None]] = []
        self.reason: str | None = None
        self.refuses = refuses
        self.in_script = self.attached = False

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
                other processes did not meet one.
        """
        if self.reason is not None:
            return
        if self.in_script and isinstance(error, SkipGSError) and error.in_script is not None:
            error.args = (error.in_script,)
        if self.ends(error, refuses) or (self._enabled and not distributed.all_failed(step)):
            self._take_back()
            raise error
        self.release(error, step)

    def ends(self, error: Exception, refuses: bool = True) -> bool:
        """Return whether an error ends the training: a refusal that costs nothing, or an error of the training itself.

        Args:
            error: The error.
            refuses: See `on_error`.
        """
        if isinstance(error, BrokenTrainingError) or (isinstance(error, GateOrderError) and self.attached):
            return True
        if isinstance(error, DivergedError):
            return not self.attached
        if not self._enabled or not isinstance(error, SkipGSError):
            return False
        return refuses and self.refuses()

    def release(self, error: Exception, step: int | None) -> None:
        """Release the gate after an error of which all processes know, and warn with its message."""
        expected = isinstance(error, SkipGSError)
        why = str(error) if expected else f"{type(error).__name__}: {error}; report it to the project skipgs_plug"
        where = "" if step is None else f" in iteration {step}"
        log.debug("The error that releases the gate:", exc_info=error)
        released = f"The gate is released{where}, and training goes on without it, in all its iterations"
        self.let_go(
            f"{released if self._enabled else f'Training goes on, but its counts and times end{where}'} ({why})"
        )

    def agreed(
        self, decide: Callable[[], Decision], step: int, device: torch.device | None
    ) -> tuple[Decision, Decision]:
        """Return this rank's decision, and the one on which all ranks agree; both are INACTIVE if the gate is released.

        Args:
            decide: Returns the decision of this rank.
            step: Present iteration.
            device: See `distributed.agree`.

        Raises:
            Exception: An error on this rank or on another one ends the training.
        """
        try:
            own = decide()
        except Exception as error:
            ends = self.ends(error)
            distributed.tell_error(ends, device)
            if ends:
                raise
            self.release(error, step)
            return decision.INACTIVE, decision.INACTIVE
        answer = distributed.agree(own, device)
        if answer is not None:
            return own, answer
        self.release(SkipGSError("the gate of another process is released; see its output"), step)
        return decision.INACTIVE, decision.INACTIVE

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
            with cautioned("Detaching the gate"):
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
