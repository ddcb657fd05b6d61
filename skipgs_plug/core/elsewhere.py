"""Training by code that the adapter does not know, while it waits for the trainer that it knows."""

from __future__ import annotations

from collections.abc import Callable, Set

from skipgs_plug.core.caution import caution

# Backward passes of other functions that count as training, of which the user is warned: few enough to stop in time.
# One or two can belong to a preparation.
TRAINED_AFTER = 10


class Elsewhere:
    """Counts backward passes of functions that the adapter does not know.

    Args:
        awaited: Names of what the adapter expects and has not seen yet; it changes.
        adapter: Name of the adapter.
        matters: Returns whether the gate is on and has not seen any training.
    """

    def __init__(self, awaited: Set[str], adapter: str, matters: Callable[[], bool]) -> None:
        self._awaited, self._adapter, self._matters = awaited, adapter, matters
        self._seen = 0

    @property
    def expected(self) -> str:
        """What is awaited, as text."""
        return " or ".join(sorted(self._awaited))

    @property
    def trained(self) -> bool:
        """Whether other functions may have trained, so that a refusal would lose what they did."""
        return self._seen >= TRAINED_AFTER

    def note(self, caller: str) -> None:
        """Count a backward pass of a function, and warn once. It may train, or prepare something, so the run goes on.

        Args:
            caller: Name of the function.
        """
        self._seen += 1
        if self._seen == TRAINED_AFTER and self._awaited and self._matters():
            who = "The script itself" if caller == "<module>" else f"{caller}()"
            caution(
                f"{who} called backward, and no {self.expected} was seen, to which adapter {self._adapter!r} attaches. "
                f"If this is training, nothing is gated: gate its loop by hand with SkipGate(start_iter=...), as in "
                "docs/gate.md."
            )
