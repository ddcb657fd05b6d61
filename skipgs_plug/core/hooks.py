"""What an adapter has in its hands while it attaches a gate to a trainer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch

from skipgs_plug.core.errors import AdapterMismatchError, SkipGSError
from skipgs_plug.core.intercept import Around, Patches, intercept_tensor_backward
from skipgs_plug.core.views import view_key

if TYPE_CHECKING:
    from skipgs_plug.core.adapter import Adapter
    from skipgs_plug.core.engine import Engine

CHECKED_ITERATIONS = 10  # after these, exactly one training backward each must have been seen


class Hooks:
    """Tells a gate what a trainer does: iterations, views, backwards, structural changes.

    An iteration opens a window, the first training backward in it is gated, and any further one passes
    through and counts as a mismatch.
    """

    def __init__(self, engine: Engine, adapter: Adapter, given: frozenset[str]) -> None:
        """Make hooks for an adapter; `given` names the settings that the user gave."""
        self._engine = engine
        self._adapter = adapter
        self._given = given
        self._expectation = f"Adapter {adapter.name!r} was checked with {adapter.checked}."
        self._patches = Patches(self._expectation)
        self._ready = False
        self._view: Any = None
        self._signal: Any = None
        self._iterations = 0
        self._backwards_now = 0  # in the present iteration
        self._backwards = 0
        self._odd_iterations = 0

    # What the adapter learns, at attach or when training begins.

    @property
    def is_ready(self) -> bool:
        """Whether `ready` was called."""
        return self._ready

    def ready(
        self,
        start_iter: int | None,
        *,
        view_names: Iterable[str] | None = None,
        max_steps: int | None = None,
        world_size: int | None = None,
        gradients_read_until: int | None = None,
        defaults: dict[str, Any] | None = None,
    ) -> None:
        """Give what must be known before the first iteration.

        Args:
            start_iter: First iteration after densification, in the trainer's counting; None when it has no
                densification to end.
            view_names: Keys of all training views, checked for uniqueness.
            max_steps: Last iteration; a gate that starts after it is worth a warning.
            world_size: Number of processes, when the trainer knows better than WORLD_SIZE.
            gradients_read_until: Before this iteration more than the optimizers reads gradients, densification
                say, so that a gate which the user starts earlier is refused.
            defaults: Settings that suit this trainer, used where the user gave none.
        """
        suggested = {name: value for name, value in (defaults or {}).items() if name not in self._given}
        self._engine.configure(start_iter, view_names, max_steps, world_size, gradients_read_until, suggested)
        self._ready = True

    # What the trainer does.

    def iteration(self, step: int) -> None:
        """Iteration `step` begins: its first training backward will be gated."""
        with self._detaching_on_error():
            if not self._ready:
                raise self._mismatch("the trainer iterates before it said when densification ends")
            self._close_iteration()
            self._iterations += 1
            self._backwards_now = 0
            self._view = self._signal = None
            self._engine.open_iteration(step)
            if self._engine.steps.accumulating:
                self._engine.steps.attach(self, self._adapter.optimizers, self._engine)

    def view(self, key: Any) -> None:
        """The present iteration renders this view for training; the last one before the backward counts.

        Args:
            key: As for `SkipGate.backward`; or a function that gives it, called in gated iterations only, for
                a key that has to be read from the device.
        """
        self._view = key

    def signal(self, value: float | torch.Tensor) -> None:
        """Decide on this value in the present iteration, instead of on the loss that is backpropagated."""
        self._signal = value

    def event(self, kind: str) -> None:
        """A structural change (prune, opacity reset, optimizer rebuild) happens now; before training none counts."""
        if self._engine.policy is not None and self._engine.step is not None:
            self._engine.notify_event(kind, self._engine.step)

    def backward(self, loss: torch.Tensor, run: Callable[[], Any], view: Any = None) -> Any:
        """Gate a training backward: `run()` is the real one, and is called unless it is skipped."""
        with self._detaching_on_error():
            self._backwards_now += 1
            self._backwards += 1
            if self._iterations == 0:
                if self._backwards >= CHECKED_ITERATIONS:
                    raise self._mismatch(f"{self._backwards} training backwards ran in no iteration")
                return run()
            if self._backwards_now > 1:
                return run()
            view = self._view if view is None else view
            if view is None:
                raise self._mismatch("no training view was rendered before the backward")
            if callable(view):
                view = view() if self._engine.active else "not read"
            self._engine.gate(view_key(view), loss if self._signal is None else self._signal, run)
            return None

    # How to hold on to the trainer.

    def wrap(self, owner: Any, name: str, around: Around) -> None:
        """Call `around(original, *args, **kwargs)` in place of `owner.name`; see `Patches.wrap`."""
        self._patches.wrap(owner, name, around)

    def before(self, owner: Any, name: str, call: Callable[..., Any]) -> None:
        """Call `call(*args, **kwargs)` before each `owner.name(*args, **kwargs)`."""

        def around(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            call(*args, **kwargs)
            return original(*args, **kwargs)

        self.wrap(owner, name, around)

    def events(self, owner: Any, *names: str) -> None:
        """Report each call of these methods as a structural change of that name."""
        for name in names:
            self.before(owner, name, lambda *args, _kind=name, **kwargs: self.event(_kind))

    def suppress_on_skip(self, owner: Any, *names: str) -> None:
        """Leave out calls of these methods in iterations whose backward was skipped.

        For side effects that belong to a gradient step but need no gradient, such as position noise.
        """

        def around(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            return None if self._engine.skipped else original(*args, **kwargs)

        for name in names:
            self.wrap(owner, name, around)

    def gate_tensor_backward(self, *callers: str) -> None:
        """Gate the scalar `Tensor.backward` that functions of these names call themselves."""
        intercept_tensor_backward(self._patches, callers, self.backward)

    def on_detach(self, label: str, undo: Callable[[], None]) -> None:
        """Have something else taken back by `detach`."""
        self._patches.add_undo(label, undo)

    @property
    def state(self) -> Engine:
        """What has `state_dict` and `load_state_dict`, for trainers that carry others' state along."""
        return self._engine

    # What the gate asks.

    @property
    def patched(self) -> list[str]:
        """Every name that is replaced at present."""
        return self._patches.names

    def restore(self) -> None:
        """Put back every replaced name."""
        self._patches.restore()

    def verify(self) -> None:
        """Raise AdapterMismatchError unless training ran, with one training backward per iteration."""
        if self._iterations == 0:
            raise self._mismatch("no iteration of a training loop was seen")
        self._close_iteration(final=True)

    def _close_iteration(self, final: bool = False) -> None:
        if self._iterations == 0 or self._iterations > CHECKED_ITERATIONS:
            return
        if self._backwards_now != 1:
            self._odd_iterations += 1
        if self._odd_iterations and (final or self._iterations == CHECKED_ITERATIONS):
            raise self._mismatch(
                f"{self._backwards} training backwards were seen in {self._iterations} iterations, "
                f"where one per iteration was expected"
            )

    def _mismatch(self, what: str) -> AdapterMismatchError:
        return AdapterMismatchError(
            f"The trainer does not behave as expected: {what}. {self._expectation} "
            "Name another adapter, or gate the loop by hand with SkipGate(start_iter=...)."
        )

    @contextmanager
    def _detaching_on_error(self) -> Iterator[None]:
        """Leave nothing patched behind when the gate itself gives up."""
        try:
            yield
        except SkipGSError:
            self.restore()
            raise
