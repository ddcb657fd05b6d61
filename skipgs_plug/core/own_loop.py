"""The verbs of a training loop of the user's own: iterations, backward, step and update."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch
from torch import Tensor

from skipgs_plug.core.engine import Engine
from skipgs_plug.core.errors import GateOrderError, SkipGSError
from skipgs_plug.core.intercept import Patches
from skipgs_plug.core.loss_scaler import guard_scalers, unscaled
from skipgs_plug.core.optimizers import has_pending_gradient, listed
from skipgs_plug.core.pace.base import EveryNumber, Source
from skipgs_plug.core.pace.loop_range import LoopRange
from skipgs_plug.core.pace.schedulers import schedulers_caught_up
from skipgs_plug.core.trainer_info import Densification
from skipgs_plug.core.views import NOT_READ, view_key


class OwnLoop:
    """Drives an engine by the verbs that a user's loop calls; see the methods of `SkipGate` with these names.

    An error of the gate's own code releases the gate, and the verbs then do the work of a loop without a gate.

    Args:
        engine: Engine of the gate.

    Attributes:
        guarded: A block of the gate's own code. An error in it releases the gate, and the loop continues.
        patches: List of the names that are replaced in PyTorch.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._iteration = iteration = engine.iteration
        self._release = engine.release
        self.guarded = self._release.guarded(lambda: iteration.step)
        self.patches = Patches()
        if engine.config.enabled and not self._release.attached:  # adapters guard the scalers of their trainers
            guard_scalers(self.patches, iteration)

    def iterations(
        self,
        numbers: range,
        source: Source | None,
        always: Iterable[int] | None,
        views: Iterable[Any] | None,
        events: Iterable[int] | None,
        resets: Iterable[int] | None,
    ) -> LoopRange:
        """Return the iterations that run.

        Args:
            numbers: Iterations of the loop.
            source: Code in which the loop's conditions are read; None to read no conditions.
            always: Iterations that must run; see `Pace.follow`.
            views: Keys of all training views; None if they are unknown.
            events: Iterations that densify; None if they are unknown.
            resets: Iterations that reset opacities; None if they are unknown.

        Raises:
            SkipGSError: See `SkipGate.iterations`.
        """
        if not isinstance(numbers, range) or numbers.step != 1:
            raise SkipGSError("iterations() takes a range that goes up by one, such as range(30_000).")
        if isinstance(views, str):
            raise SkipGSError(f"views= takes a list of all names of training views, not the one name {views!r}.")
        if resets is not None and events is None:
            raise SkipGSError("resets= is for loops whose densification events are known: give events=, too.")
        if views is not None and not isinstance(views, Iterable):
            raise SkipGSError(f"views= takes a list of all names of training views, not {views!r}.")
        for name, given in {"always": always, "events": events, "resets": resets}.items():
            _require_iterations(name, given)
        with self.guarded:
            keys = list(dict.fromkeys(view_key(view) for view in (() if views is None else views))) or None
            pace, on_error = self._engine.pace, self._release.on_error
            reset_numbers = None if resets is None else _among(resets)
            known = None if events is None else Densification(numbers=_among(events), reset_numbers=reset_numbers)
            loop = pace.follow(numbers, source, always, keys, known)
            if pace.leaves_out and not self._release.attached:  # adapters step the schedulers of their trainers
                loop.around = lambda: schedulers_caught_up(pace, lambda error: on_error(error, pace.number))
            return loop
        return LoopRange(numbers, EveryNumber(lambda: None))

    def backward(self, loss: Any, view: Any, step: int, signal: Any) -> bool:
        """Run `loss.backward()`, or skip it; return True when gradients were computed.

        Args:
            loss: Scalar loss of the view, or a list of losses with a list of keys as `view`.
            view: Stable key of the view.
            step: Number of the iteration.
            signal: Value, or list of values, to decide by.

        Raises:
            GateOrderError: The verbs were called out of order.
            SkipGSError: See `SkipGate.backward`.
        """
        batch = isinstance(view, list)
        if batch:
            _require_losses(loss, view)
        elif not hasattr(loss, "backward"):
            raise _no_loss(loss)
        step = int(step)
        now = self._iteration
        passes = now.passes
        now.running = False
        if self._release.reason is None:
            try:
                return self._gated_backward(loss, view, step, signal)
            except Exception as error:
                if now.running:
                    raise  # the error comes from the loop's own backward pass
                self._release.on_error(error, step)
        returned = now.passes > passes
        now.begin(step, gated=False)
        if returned:
            now.ran = True
        else:
            now.run(lambda: _backward_of_sum(loss) if batch else loss.backward())
        return True

    def step(self, optimizer: Any, *args: Any) -> bool:
        """Call `optimizer.step(*args)` if a gradient is pending; return True when it stepped.

        Args:
            optimizer: One optimizer, or a list or dict of all that step together.
            *args: Arguments of `optimizer.step`.

        Raises:
            GateOrderError: `backward` was not called first in this iteration, or the optimizer has stepped in it.
        """
        self._require_backward_before("step")
        optimizers = stepping = listed(optimizer)
        if self._release.reason is None:
            stepped = self._iteration.stepped
            for one in optimizers:
                if id(one) in stepped:
                    self._refuse(
                        "step() was called twice for one optimizer in this iteration; call it once, after backward()."
                    )
            for one in optimizers:
                stepped.add(id(one))
            if self._engine.config.enabled and self._release.reason is None:  # otherwise every optimizer steps
                try:
                    stepping = [one for one in optimizers if has_pending_gradient(one)]
                except Exception as error:
                    self._release.on_error(error, self._iteration.step)
        for one in stepping:
            one.step(*args)
        return bool(stepping)

    def update(self) -> None:
        """End the iteration and free the graph of a skipped backward pass.

        Raises:
            GateOrderError: `backward` was not called first in this iteration.
        """
        self._require_backward_before("update")
        self._iteration.ended = True
        try:
            self._engine.free_skipped()
        except Exception as error:
            self._release.on_error(error, self._iteration.step)

    def _gated_backward(self, loss: Any, view: Any, step: int, signal: Any) -> bool:
        """Do the work of `backward` while the gate is not released."""
        engine, now = self._engine, self._iteration
        if step != now.step:
            engine.open_iteration(step)
        elif now.ended or now.stepped:
            verb = "update" if now.ended else "step"
            raise GateOrderError(
                f"backward() was called after {verb}() in iteration {step}; call backward() for all views of an "
                "iteration first, and give each iteration its own step number."
            )
        if isinstance(view, list):
            return self._backward_batch(loss, view, signal)
        key = self._new_in_iteration(view)
        now.keys.add(key)
        return engine.gate(key, signal, loss.backward, loss)

    def _backward_batch(self, losses: Any, views: list[Any], signals: Any) -> bool:
        if not len(losses) == len(views) == len(signals):
            raise SkipGSError(f"{len(views)} view keys came with {len(losses)} losses; give one loss per view.")
        keys = [self._new_in_iteration(view) for view in views]  # a batch may hold a view twice
        self._iteration.keys.update(keys)
        answers = [self._engine.decide(key, unscaled(signal)) for key, signal in zip(keys, signals, strict=True)]
        kept = [loss for loss, answer in zip(losses, answers, strict=True) if not answer.skip]
        if kept:
            self._iteration.run(lambda: _backward_of_sum(kept))
            self._engine.rates.ran()
        self._engine.clock.mark()
        return bool(kept)

    def _new_in_iteration(self, view: Any) -> str:
        """Return the key of a view that has had no backward pass in this iteration.

        Before `start_iter` an index on a device is not read: reading it would wait for the device.
        """
        now = self._iteration
        if not now.gated and isinstance(view, Tensor) and _is_index_on_device(view):
            return NOT_READ
        key = view_key(view)
        if key in now.keys:
            raise GateOrderError(
                f"backward() was called twice for view {key!r} in iteration {now.step}; give each iteration its own "
                "step number, and call backward() once for each view (the closure of LBFGS runs several times)."
            )
        return key

    def _require_backward_before(self, verb: str) -> None:
        if self._release.reason is None and (self._iteration.ended or not self._iteration.keys):
            self._refuse(f"{verb}() was called before backward() in this iteration; call it after backward().")

    def _refuse(self, sentence: str) -> None:
        """Raise an error of order in the first iteration; in later ones it releases the gate."""
        self._release.on_error(GateOrderError(sentence), self._iteration.step)


def _require_losses(losses: Any, views: list[Any]) -> None:
    if not isinstance(losses, (list, tuple)) and not (isinstance(losses, Tensor) and losses.dim()):
        raise SkipGSError(f"{len(views)} view keys came with one loss; give one loss per view.")
    for loss in losses:
        if not hasattr(loss, "backward"):
            raise _no_loss(loss)


def _no_loss(loss: Any) -> SkipGSError:
    return SkipGSError(f"backward() needs the loss itself, a tensor, not {type(loss).__name__}.")


def _is_index_on_device(view: Tensor) -> bool:
    return view.numel() == 1 and not view.is_floating_point() and not view.is_cpu


def _backward_of_sum(losses: Iterable[Tensor]) -> None:
    torch.stack(list(losses)).sum().backward()


def _require_iterations(name: str, given: Any) -> None:
    """Raise SkipGSError unless an argument holds iterations. A generator is not read, since that works only once."""
    if given is None or isinstance(given, Iterator):
        return
    example = f"{name}= takes iterations, such as range(600, 15_000, 100)"
    if not isinstance(given, Iterable) or isinstance(given, (str, bytes)):
        raise SkipGSError(f"{example}, not {given!r}.")
    for number in given:
        try:
            operator.index(number)
        except TypeError:
            raise SkipGSError(f"{example}, and no {number!r} among them.") from None


def _among(numbers: Iterable[int]) -> Callable[[range], Iterable[int]]:
    """Return a function that returns which of these numbers are in a range."""
    return frozenset(int(number) for number in numbers).intersection
