"""Keeps PyTorch's learning-rate schedulers in step: they count calls, which left-out iterations do not make."""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Callable, Iterator
from fractions import Fraction
from threading import Lock, get_ident
from typing import Any, NamedTuple

from torch.optim.lr_scheduler import ChainedScheduler, CosineAnnealingWarmRestarts, LRScheduler, SequentialLR

from skipgs_plug.core.intercept import Original, Patches
from skipgs_plug.core.pace.base import Pace

# Classes with a `step` of their own that counts its calls.
COUNTING = (LRScheduler, ChainedScheduler, SequentialLR, CosineAnnealingWarmRestarts)


def catch_up_schedulers(patches: Patches, pace: Pace) -> None:
    """Keep every scheduler that the training loop of a trainer steps where it would be if all iterations ran.

    Args:
        patches: List of replacements, to which `step` of the schedulers is added.
        pace: Leaves out iterations.
    """
    loop = _Schedulers(pace)
    for kind in COUNTING:
        patches.wrap(kind, "step", loop.step)


@contextlib.contextmanager
def schedulers_caught_up(pace: Pace, on_error: Callable[[Exception], None]) -> Iterator[None]:
    """Keep every scheduler that a loop of the user's own steps where it would be if all iterations ran.

    It holds inside the `with` statement, for loops in this thread.

    Several such loops may run at a time, in threads or one inside another.

    Args:
        pace: Leaves out iterations.
        on_error: Receives errors of the gate's own code, and raises them or releases the gate.
    """
    loop = _RunningLoop(get_ident(), _Schedulers(pace), on_error)
    with _lock:
        if not _running:
            for kind in COUNTING:
                _replaced.wrap(kind, "step", _step_of_running_loop)
        _running.append(loop)
    try:
        yield
    finally:
        with _lock:
            _running.remove(loop)
            if not _running:
                _replaced.restore()


class _Schedulers:
    """The schedulers that one training loop steps."""

    def __init__(self, pace: Pace) -> None:
        self._pace = pace
        self._known: weakref.WeakKeyDictionary[Any, _Steps] = weakref.WeakKeyDictionary()
        self._under_way = False  # a scheduler that is made of others steps them itself

    def step(self, original: Callable[..., Any], scheduler: Any, *args: Any, **kwargs: Any) -> Any:
        """Step a scheduler as often as is missing."""
        number = self._pace.number
        if self._under_way or number is None or args or kwargs:  # a step to a given epoch counts nothing
            return original(scheduler, *args, **kwargs)
        steps = self._known.setdefault(scheduler, _Steps(self._pace))
        self._under_way = True
        try:
            for _ in range(steps.due(self._pace, number, scheduler)):
                original(scheduler)
        finally:
            self._under_way = False
        steps.at = getattr(scheduler, "last_epoch", None)


class _RunningLoop(NamedTuple):
    """A loop of a user's own that runs at present."""

    thread: int
    schedulers: _Schedulers
    on_error: Callable[[Exception], None]


_running: list[_RunningLoop] = []  # inner loops come last
_replaced = Patches()
_lock = Lock()


def _step_of_running_loop(original: Original, scheduler: Any, *args: Any, **kwargs: Any) -> Any:
    """Do the work of `step` of a scheduler, for the innermost loop in this thread."""
    loop = next((one for one in reversed(_running) if one.thread == get_ident()), None)
    if loop is None:
        return original(scheduler, *args, **kwargs)
    try:
        return loop.schedulers.step(original, scheduler, *args, **kwargs)
    except Exception as error:
        if original.failed:
            raise
        loop.on_error(error)
        return original.result if original.made else original(scheduler, *args, **kwargs)


class _Steps:
    """The steps that one scheduler lacks because iterations were left out.

    A scheduler steps in every iteration if it steps in one that no condition of the loop names. Until then it may step
    in every hundredth iteration, for example. Such a scheduler lacks no step, because its iterations are not left out.

    A library may count iterations itself, and step a scheduler in every fourth that runs. Each step is then one for
    four iterations, so the iterations left out since the last step count a quarter each.

    A loop of the user's own can make up for left-out iterations itself: by further calls of `step`, which then do
    nothing here, or by setting the epoch of the scheduler. Another loop may step twice in each iteration. The first
    iteration without a gap shows the usual number of calls; until then, second calls do nothing and are noted down.

    A new scheduler counts as one that stepped in the iteration before.

    Args:
        pace: Leaves out iterations.

    Attributes:
        at: Epoch of the scheduler after its last step here; None if it has none.
    """

    def __init__(self, pace: Pace) -> None:
        self.at: Any = None
        self._in_every_iteration = False
        self._number: int | None = None  # last iteration with a call
        self._ran, self._left_out = pace.ran - 1, pace.left_out - pace.gap  # as of that iteration
        self._lacks = Fraction(0)  # steps that each call in that iteration lacks
        self._calls = 0  # calls in that iteration
        self._ahead = 0  # steps in that iteration that were made before the loop asked for them
        self._missing = Fraction(0)
        self._usual: int | None = None  # calls in an iteration without a gap; None while unknown
        self._noted = Fraction(0)  # steps for the calls that did nothing while it was unknown

    def due(self, pace: Pace, number: int, scheduler: Any) -> int:
        """Return the number of steps to make at a call in iteration `number`, the present one."""
        if not hasattr(scheduler, "_last_lr"):  # its first step, which its class makes
            self._number, self._ran, self._left_out = number, pace.ran, pace.left_out
            return 1
        if number != self._number:
            self._begin(pace, number)
        self._calls += 1
        if self._lacks and self._calls > (self._usual or 1) and self._ahead:
            self._ahead -= 1
            if self._usual is None:
                self._noted += 1 + self._lacks
            return 0
        moved_by_loop = self.at is not None and scheduler.last_epoch != self.at
        self._missing = Fraction(0) if moved_by_loop else self._missing + self._lacks
        self._in_every_iteration = self._in_every_iteration or not pace.is_named(number)
        if not self._in_every_iteration:
            return 1
        missing = int(self._missing)
        self._missing -= missing
        self._ahead += missing
        return 1 + missing

    def _begin(self, pace: Pace, number: int) -> None:
        """Begin an iteration, and learn from the calls in the last one."""
        if self._calls and not self._lacks:
            if self._usual is None and self._calls > 1:
                self._missing += self._noted
            self._usual = max(self._usual or 1, self._calls)
        ran = max(1, pace.ran - self._ran)  # a number may be reported that the loop was not asked about
        self._lacks = Fraction(pace.left_out - self._left_out, ran)
        self._number, self._ran, self._left_out = number, pace.ran, pace.left_out
        self._calls = self._ahead = 0
