"""Everything that skipgs_plug raises on purpose."""

from __future__ import annotations


class SkipGSError(RuntimeError):
    """Base of all errors of the gate and the adapters: one sentence that names the thing and the fix."""


class UnknownTrainerError(SkipGSError):
    """No adapter recognises the trainer, or there is none of the given name."""


class AdapterMismatchError(SkipGSError):
    """The trainer does not have, or does not do, what its adapter expects."""


class GateOrderError(SkipGSError):
    """A verb of the gate was called out of order."""
