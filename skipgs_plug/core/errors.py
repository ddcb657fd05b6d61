"""Everything that skipgs_plug raises on purpose."""

from __future__ import annotations

import warnings


class SkipGSError(RuntimeError):
    """Base of all errors of the gate and the adapters: one sentence that names the thing and the fix."""


class UnknownTrainerError(SkipGSError):
    """No adapter recognises the trainer, or none has the given name."""


class AdapterMismatchError(SkipGSError):
    """The trainer lacks an attribute, or behaves differently, than its adapter expects."""


class BrokenTrainingError(SkipGSError):
    """The training itself is broken, such as by losses that stay non-finite: it is raised at any time."""


class GateOrderError(SkipGSError):
    """A verb of the gate was called out of order."""


def warn_of_release(error: Exception, step: int | None) -> str:
    """Warn that the gate let go, and return the sentence. Training continues: no run is lost to the gate."""
    reason = str(error) if isinstance(error, SkipGSError) else f"{type(error).__name__}: {error}"
    said = (
        f"The gate is released in iteration {step}, and training goes on without it, in all its iterations ({reason})"
    )
    warnings.warn(said, RuntimeWarning, stacklevel=3)
    return said
