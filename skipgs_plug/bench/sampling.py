"""Controls that leave out whole iterations of a whole run without reading any loss. Standard library only."""

from __future__ import annotations

import random
from collections.abc import Iterable


def random_numbers(numbers: range, events: Iterable[int], count: int, seed: int) -> set[int]:
    """Return `count` of the numbers: all events, and others drawn at random from a generator seeded with `seed`.

    If there are more events than `count`, return all events.
    """
    kept = set(events)
    others = [n for n in numbers if n not in kept]
    return kept | set(random.Random(seed).sample(others, max(0, count - len(kept))))


def periodic_numbers(numbers: range, events: Iterable[int], count: int, seed: int) -> set[int]:
    """Return `count` of the numbers: all events, and others spread as evenly as whole numbers allow."""
    kept = set(events)
    others = [n for n in numbers if n not in kept]
    n, wanted = len(others), max(0, count - len(kept))
    return kept | {other for i, other in enumerate(others) if (i + 1) * wanted // n > i * wanted // n}
