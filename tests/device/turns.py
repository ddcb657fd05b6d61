"""Which look-alikes train on the simulated device today: all would take two minutes."""

from __future__ import annotations

A_TURN = 5  # look-alikes of one day, which take about 20 seconds


def chosen(names: list[str], turn: str) -> list[str]:
    """Return the names of a turn, given as a number of days, or of "all"."""
    if turn == "all":
        return names
    first = int(turn) % -(-len(names) // A_TURN) * A_TURN
    return names[first : first + A_TURN]
