"""The interface between a gate and an adapter: the questions of the gate, and the hooks with which adapters attach."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Any, ClassVar, Protocol

import torch

from skipgs_plug.core.clock import Times
from skipgs_plug.core.drift_check import DriftCheck
from skipgs_plug.core.elsewhere import Elsewhere
from skipgs_plug.core.engine import Engine
from skipgs_plug.core.errors import AdapterMismatchError, SkipGSError
from skipgs_plug.core.gaussian_count import GaussianCount
from skipgs_plug.core.intercept import Original, Patches, intercept_tensor_backward
from skipgs_plug.core.loop_hooks import LoopHooks
from skipgs_plug.core.loss_scaler import guard_scalers
from skipgs_plug.core.optimizers import Optimizers
from skipgs_plug.core.trainer_info import TrainerInfo
from skipgs_plug.core.views import NOT_READ, view_key

# First iterations in which training backward passes are counted. Any number but one in each is a wrong attachment, and
# the user hears of it within seconds.
CHECKED_ITERATIONS = 10


class Adapter(Protocol):
    """One trainer's answers; see `skipgs_plug.adapters.AbstractAdapter` for their meaning."""

    name: ClassVar[str]
    checked: ClassVar[str]
    saved_state: Callable[[int], dict[str, Any] | None] | None
    output_folder: str | None
    replaced: Sequence[str]

    def attach(self, hooks: Hooks) -> None:
        """Attach the gate to a trainer that exists."""

    def attach_script(self, hooks: Hooks) -> None:
        """Attach the gate to a script that is about to run in this process."""

    def must_run(self, step: int) -> bool:
        """Return whether the backward pass of this iteration must not be skipped."""

    def optimizers(self) -> Iterable[torch.optim.Optimizer]:
        """Return the optimizers of the training loop."""

    def timing(self) -> Times | None:
        """Return the times that the trainer measures itself, or None."""


class Hooks(LoopHooks):
    """Reports the iterations, views, backward passes and structural changes of a trainer to a gate.

    The first training backward pass of an iteration is gated. Any further one runs and counts as a mismatch.

    Attributes:
        awaited: Names of what the adapter expects of the trainer and has not seen yet, such as modules that the script
            imports. A run whose first training backward pass comes outside of any iteration, and before all of them
            were seen, is refused.
    """

    def __init__(self, engine: Engine, adapter: Adapter, given: frozenset[str], in_script: bool = False) -> None:
        """Create hooks for an adapter.

        Args:
            engine: Engine of the gate.
            adapter: The adapter.
            given: Names of the settings that the user gave.
            in_script: Whether the trainer is a script, whose user cannot attach a new gate for a second run in it.
        """
        self._expectation = f"Adapter {adapter.name!r} was checked with {adapter.checked}."
        super().__init__(engine, adapter.optimizers, Patches(self._expectation, self._failed))
        self._adapter, self._given = adapter, given
        self._release, self._iteration = engine.release, engine.iteration
        self._release.undoes(self.restore)
        self._release.refuses = lambda: not self._has_trained
        self._release.in_script, self._release.attached = in_script, True
        self._guarded = self._release.guarded(lambda: self._iteration.step)
        self._ready = False
        self.script_globals: dict[str, Any] = {}
        self._drift: DriftCheck | None = None
        self._count: GaussianCount | None = None
        self._iterations = self._backwards = 0
        self._odd_iterations = 0  # iterations with a number of backward passes other than one, so far
        self._callers: set[str] = set()  # functions whose backward passes are gated
        self.awaited: set[str] = set()
        self._elsewhere = Elsewhere(self.awaited, adapter.name, lambda: engine.config.enabled and not self.trained)

    # Facts, at attach or when training begins.

    def ready(self, info: TrainerInfo) -> None:
        """Pass on the facts that must be known before the first iteration.

        Args:
            info: Facts about the trainer.

        Raises:
            SkipGSError: The settings do not fit the trainer; see `Engine.configure`.
        """
        with self.guarded():
            if (folder := self._adapter.output_folder) is not None:
                self._adapter.output_folder = os.path.abspath(folder)  # a script may change its working folder
            self._engine.configure(info, self._given)
            if self._engine.config.compensates:
                self.on_detach("torch.optim.Optimizer.step (hooks)", self._engine.remove)
            self._ready = True

    # Reports during training.

    def iteration(self, step: int) -> None:
        """Begin an iteration, whose first training backward pass will be gated.

        Args:
            step: Number of the iteration, counted as the trainer counts. It may not decrease.

        Raises:
            AdapterMismatchError: This is the first iteration, and it came before `ready`. Later errors release the
                gate.
            SkipGSError: This is the first iteration, and the gate refuses the run.
        """
        if self.released:
            return
        step = int(step)  # a NumPy number would get into saved states
        with self._release.guarded(lambda: step):
            if not self._ready:
                raise self._mismatch("the trainer iterates before it said when densification ends")
            if self._iterations == CHECKED_ITERATIONS:
                self._require_one_backward_each()
            if self._count is not None and self._count.changed():
                self.event("number of Gaussians")
            if self._drift is not None and (moved := self._drift.moved()):
                self._release_moved(moved)
                return
            before = self._iteration.step
            if before is not None and step < before and (self._release.in_script or not self._engine.config.enabled):
                back = f"iterations went back from {before} to {step}, as in a second training run of one process"
                self._release.release(SkipGSError(back), step)
                return
            self._iterations += 1
            self._odd_iterations += 1  # until its backward is seen
            self._engine.open_iteration(step)

    def view(self, key: Any) -> None:
        """Report the view that the present iteration trains on. The last report before the backward pass counts.

        Args:
            key: A key as for `SkipGate.backward`, or a function that returns it. The function is called in gated
                iterations only, for a key that must be read from the device.
        """
        self._iteration.view = key

    def signal(self, value: float | torch.Tensor) -> None:
        """Decide by this value in the present iteration, instead of by the loss.

        Args:
            value: The number to decide by, such as the image term of the loss; a tensor has one element.
        """
        self._iteration.signal = value

    def event(self, kind: str) -> None:
        """Report a structural change (prune, opacity reset, new optimizer). Changes before training do not count.

        Args:
            kind: Name of the change for the report, such as the name of the method.
        """
        step = self._iteration.step
        if self._engine.policy is not None and step is not None:
            self._engine.notify_event(kind, step)

    def backward(self, loss: torch.Tensor, run: Callable[[], Any], view: Any = None, keeps_graph: bool = False) -> Any:
        """Gate a training backward pass: run it, unless it is skipped.

        Args:
            loss: The tensor whose backward pass runs.
            run: Runs the backward pass.
            view: Key of the view; None for the key that `view` reported.
            keeps_graph: Whether the trainer may need the graph of the loss after this backward pass.

        Returns:
            The result of `run()` if the gate does not handle this backward pass, else None.

        Raises:
            AdapterMismatchError: This is the first iteration, and no view was reported.
            SkipGSError: This is the first iteration, and the gate refuses the run.
        """
        if self.released:
            return run()
        call = Original(run)
        try:
            if not self._is_training_backward():
                return call()
            self._gate(loss, view, call, keeps_graph)
        except Exception as error:
            if call.failed:
                raise  # the trainer's own
            self._failed(error)
        # After a release the trainer needs its backward pass, because the gate no longer handles skipped iterations.
        return call() if self.released and not call.made else None

    def _is_training_backward(self) -> bool:
        """Whether this backward is the first of an iteration."""
        self._backwards += 1
        if self._iterations == 0:
            if self._engine.config.enabled and self.awaited and self._backwards == 1:
                raise self._mismatch(f"it trains without a {self._elsewhere.expected}")
            if self._engine.config.enabled and self._backwards >= CHECKED_ITERATIONS:
                raise self._mismatch(f"{self._backwards} training backwards ran in no iteration")
            return False
        now = self._iteration
        now.backwards += 1
        if now.backwards > 1:
            self._odd_iterations += now.backwards == 2
            return False
        self._odd_iterations -= 1
        return True

    def _gate(self, loss: torch.Tensor, view: Any, call: Callable[[], Any], keeps_graph: bool) -> None:
        now = self._iteration
        view = now.view if view is None else view
        if view is None:
            raise self._mismatch("no training view was rendered before the backward")
        if callable(view):
            view = view() if self._engine.active else NOT_READ
        signal = loss if now.signal is None else now.signal
        self._engine.gate(view_key(view), signal, call, loss, frees_graph=not keeps_graph)

    # Ways to attach to the trainer.

    def events(self, owner: Any, *names: str) -> None:
        """Report each call of these methods as a structural change with the method's name.

        Args:
            owner: The object that holds the methods; see `wrap`, also for errors.
            *names: Attributes of the methods.
        """
        for name in names:
            self.before(owner, name, lambda *args, _kind=name, **kwargs: self.event(_kind))

    def suppress_on_skip(self, owner: Any, *names: str) -> None:
        """Suppress calls of these methods in iterations whose backward pass was skipped.

        For side effects that belong to a gradient step but need no gradient, such as position noise.

        Args:
            owner: The object that holds the methods; see `wrap`, also for errors.
            *names: Attributes of the methods. A suppressed call returns None.
        """

        def around(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            return None if self._engine.skipped else original(*args, **kwargs)

        for name in names:
            self.wrap(owner, name, around)

    def gate_tensor_backward(self, *callers: str) -> None:
        """Gate the scalar `Tensor.backward` that certain functions call themselves, with or without a loss scaler.

        Args:
            *callers: Names of these functions, besides those of earlier calls. A script in which one of them trains
                while a module is still awaited is refused.
        """
        if not self._callers:
            intercept_tensor_backward(self._patches, self._callers, self.backward, self._elsewhere.note)
            guard_scalers(self._patches, self._iteration)
        self._callers.update(callers)

    def check_drift(self, optimizers: Optimizers) -> None:
        """Check that no code of a fork changes the parameters of these optimizers unseen.

        If they move in skipped iterations, the gate is released, and training goes on without it; see `DriftCheck`. A
        number of Gaussians that changes without a structural change is reported as one.

        Args:
            optimizers: Returns the optimizers.
        """
        self._drift = DriftCheck(self._engine, optimizers)
        self._count = GaussianCount(self._engine.stats, optimizers)

    def _release_moved(self, names: list[str]) -> None:
        self.release(
            f"The loop moved {', '.join(names)} in iteration {self._iteration.step}, whose backward was skipped, by "
            f"code that adapter {self._adapter.name!r} does not know. The gate is released, and training goes on "
            "without it. Gate this loop by hand with SkipGate(start_iter=...)."
        )

    @property
    def state(self) -> Engine:
        """Object with `state_dict` and `load_state_dict`, for trainers that save the state of other objects too."""
        return self._engine

    @property
    def lengthens_steps(self) -> bool:
        """Whether the gate leaves out iterations, and makes the steps of the others longer."""
        return self._engine.pace.leaves_out and self._engine.config.compensates

    # Questions of the gate.

    @property
    def trained(self) -> bool:
        """Whether an iteration was seen, or a training backward pass outside of any iteration."""
        return self._iterations + self._backwards > 0

    @property
    def _has_trained(self) -> bool:
        """Whether a refusal would lose trained iterations, or an earlier stage of the script."""
        return max(self._iterations, self._backwards) > 1 or self._elsewhere.trained

    @property
    def released(self) -> bool:
        """Whether the gate was released, so that training continues without it."""
        return self._release.reason is not None

    def guarded(self) -> AbstractContextManager[None]:
        """Return a block for an adapter's own code. An error in it releases the gate, and the code after it runs.

        Functions that are put around names do not need a block: after an error there, the trainer gets the result that
        it would have without a gate.

        Raises:
            SkipGSError: The gate is on and refuses this run in its first iteration.
        """
        return self._guarded

    def release(self, reason: str) -> None:
        """Release the gate, so that training continues without it; an error would end the training.

        Args:
            reason: One sentence about the cause, which the user reads as a warning.
        """
        self._release.let_go(reason)

    def _failed(self, error: Exception) -> None:
        self._release.on_error(error, self._iteration.step)

    def verify(self) -> None:
        """Raise AdapterMismatchError unless training ran, with one training backward per iteration, or without gate."""
        if self.released:
            return
        if self._iterations == 0:
            raise self._mismatch("no iteration of a training loop was seen")
        if self._iterations <= CHECKED_ITERATIONS:
            self._require_one_backward_each()

    def _require_one_backward_each(self) -> None:
        if self._engine.config.enabled and self._odd_iterations:
            raise self._mismatch(
                f"{self._backwards} training backwards were seen in {self._iterations} iterations, "
                f"where one per iteration was expected"
            )

    def _mismatch(self, what: str) -> AdapterMismatchError:
        return AdapterMismatchError(
            f"The trainer does not behave as expected: {what}. {self._expectation} "
            "Name another adapter, or gate the loop by hand with SkipGate(start_iter=...)."
        )
