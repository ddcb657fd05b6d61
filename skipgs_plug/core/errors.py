"""Everything that skipgs_plug raises on purpose."""

from __future__ import annotations


class SkipGSError(RuntimeError):
    """Base of all errors of the gate and the adapters: one sentence that names the thing and the fix."""


class UnknownTrainerError(SkipGSError):
    """No adapter recognises the trainer, or none has the given name."""


class AdapterMismatchError(SkipGSError):
    """The trainer lacks an attribute, or behaves differently, than its adapter expects."""


class BrokenTrainingError(SkipGSError):
    """The training itself is broken, for example because losses stay non-finite. It is raised at any time."""


class GateOrderError(SkipGSError):
    """A verb of the gate was called out of order."""
