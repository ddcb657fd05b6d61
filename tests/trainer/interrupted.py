"""A run that was interrupted and resumed, beside one that was not."""

from collections.abc import Callable
from pathlib import Path

from skipgs_plug.trainer import Trainer


def whole_and_resumed(made: Callable[[], Trainer], stop: int, path: Path) -> tuple[Trainer, Trainer]:
    """Train two runs that `made` returns to their end, the second through a checkpoint at iteration `stop`."""
    whole, first, second = made(), made(), made()
    whole.train(progress=False)
    first.train(until=stop, progress=False)
    first.save_checkpoint(path)
    second.load_checkpoint(path)
    second.train(progress=False)
    return whole, second
