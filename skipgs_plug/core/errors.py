"""Everything that skipgs_plug raises on purpose."""

from __future__ import annotations


class SkipGSError(RuntimeError):
    """Base of all errors of the gate and the adapters: one sentence that names the thing and the fix.

    Args:
        sentence: The sentence.
        in_script: The sentence for the user of a script, who has no gate to call; None if it is the same.
    """

    def __init__(self, sentence: str = "", in_script: str | None = None) -> None:
        super().__init__(sentence)
        self.in_script = in_script


class GateStateError(SkipGSError):
    """A saved gate state cannot be used.

    Args:
        sentence: A sentence that ends with the advice "start the gate afresh.".
    """

    def __init__(self, sentence: str) -> None:
        super().__init__(sentence, in_script=f"{sentence.removesuffix('.')} with --resume-gate off.")


class UnknownTrainerError(SkipGSError):
    """No adapter recognises the trainer, or no adapter has the given name."""


class AdapterMismatchError(SkipGSError):
    """The trainer lacks an attribute that its adapter expects, or behaves differently."""


class BrokenTrainingError(SkipGSError):
    """The training itself cannot go on, for example because another process has ended. It is raised at any time."""


class DivergedError(SkipGSError):
    """Losses stay non-finite. It ends a loop of the user's own, and releases a gate that an adapter attached."""


class GateOrderError(SkipGSError):
    """A verb of the gate was called out of order."""
