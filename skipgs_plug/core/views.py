"""View keys: the names of training views in states, tables and traces."""

from __future__ import annotations

import itertools
import numbers
import os
from collections import Counter
from collections.abc import Iterable
from pathlib import PurePath
from typing import Any

from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import SkipGSError

CHECKED_KEYS = 5_000  # number of different keys at which recurrence is checked; few scenes have as many training views
RECURRING = 0.01  # least share of decisions on views seen before; below it, keys are counters and do not name views
NOT_READ = "not read"  # key in iterations whose decision does not depend on the view, so that no device must be read
MAX_VIEWS = 200_000  # largest number of views per table: more than any scene has, and about 60 MB in all


def view_key(view: Any) -> str:
    """Return the text that identifies a view.

    Args:
        view: Image name or path, index (int, or a tensor or array of one whole number), or a tuple of these.

    Raises:
        SkipGSError: The key has another type, and might differ for the same view in another run.
    """
    if isinstance(view, str):
        return str.__str__(view)  # a NumPy string must not get into saved states
    if isinstance(view, numbers.Integral):
        return str(int(view))
    if isinstance(view, os.PathLike):
        return PurePath(view).as_posix()
    if isinstance(view, tuple) and view:
        return "/".join(view_key(part) for part in view)
    item = getattr(view, "item", None)
    if callable(item) and getattr(view, "size", None) is not None:
        try:
            value = item()
        except (RuntimeError, ValueError):
            value = None
        if isinstance(value, numbers.Integral):
            return str(int(value))
    raise SkipGSError(
        f"A view key must be an image name or an index, not {type(view).__name__}; "
        "for a batch with one joint loss use one constant key, for per-view losses a list of keys."
    )


def require_unique(names: Iterable[str]) -> list[str]:
    """Return the names as a list; raise SkipGSError if several views share a name."""
    names = list(names)
    name, count = Counter(names).most_common(1)[0] if names else ("", 0)
    if count > 1:
        raise SkipGSError(
            f"View key {name!r} names {count} training views; use keys that differ, such as relative paths."
        )
    return names


def warn_unless_recurring(keys: int, decisions: int) -> None:
    """Warn if hardly any key came twice in many decisions. Call it at each new key."""
    if keys == CHECKED_KEYS and decisions - keys < RECURRING * decisions:
        caution(
            f"{keys:,} different view keys came in {decisions:,} gated decisions, and a view that does not come again "
            "is never skipped: unless there are so many training views, name the image in view=, not a counter or the "
            "id of an object."
        )


def forget_oldest(table: dict[Any, Any]) -> None:
    """Remove the older half of a table of views if it holds more than MAX_VIEWS."""
    if len(table) > MAX_VIEWS:
        for view in list(itertools.islice(table, len(table) // 2)):
            del table[view]
