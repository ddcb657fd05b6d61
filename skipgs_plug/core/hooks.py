"""What a gate asks of an adapter, and what the adapter has in its hands while it attaches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from typing import Any, ClassVar, Protocol

import torch

from skipgs_plug.core.clock import Times
from skipgs_plug.core.drift_check import DriftCheck
from skipgs_plug.core.engine import Engine
from skipgs_plug.core.errors import AdapterMismatchError
from skipgs_plug.core.intercept import Around, Original, Patches, intercept_tensor_backward
from skipgs_plug.core.optimizers import Named, Optimizers
from skipgs_plug.core.pace.base import Always, Known, nothing_always, nothing_known
from skipgs_plug.core.pace.loop_range import LoopRange, replace_range
from skipgs_plug.core.pace.phased import Phased
from skipgs_plug.core.pace.schedulers import catch_up_schedulers
from skipgs_plug.core.trainer_info import Densification, TrainerInfo
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


class Hooks:
    """Reports to a gate what a trainer does: iterations, views, backward passes, structural changes.

    The first training backward pass of an iteration is gated. Any further one runs and counts as a mismatch.
    """

    def __init__(self, engine: Engine, adapter: Adapter, given: frozenset[str], in_script: bool = False) -> None:
        """Create hooks for an adapter.

        Args:
            engine: Engine of the gate.
            adapter: The adapter.
            given: Names of the settings that the user gave.
            in_script: Whether the trainer is a script, whose user cannot attach a new gate for a second run in it.
        """
        self._engine = engine
        self._adapter = adapter
        self._given = given
        self._expectation = f"Adapter {adapter.name!r} was checked with {adapter.checked}."
        self._giving_up = engine.giving_up
        self._giving_up.undoes(self.restore)
        # Refusals come with the first iteration, when nothing is lost yet.
        self._giving_up.refuses = lambda: max(self._iterations, self._backwards) <= 1
        self._giving_up.in_script = in_script
        self._guarded = self._giving_up.guarded(lambda: self._iteration.step)
        self._patches = Patches(self._expectation, self._failed)
        self._ready = False
        self.script_globals: dict[str, Any] = {}
        self._iteration = engine.iteration
        self._drift: DriftCheck | None = None
        self._iterations = 0
        self._backwards = 0
        self._odd_iterations = 0  # iterations with a number of backward passes other than one, so far

    # Facts, at attach or when training begins.

    def ready(self, info: TrainerInfo) -> None:
        """Pass on the facts that must be known before the first iteration.

        Raises:
            SkipGSError: The settings do not fit the trainer; see `Engine.configure`.
        """
        with self.guarded():
            self._engine.configure(info, self._given)
            if self._engine.config.compensates:
                self.on_detach("torch.optim.Optimizer.step (hooks)", self._engine.release)
            self._ready = True

    # Reports during training.

    def iteration(self, step: int) -> None:
        """Begin iteration `step`: its first training backward pass will be gated."""
        if self.released:
            return
        step = int(step)  # a NumPy number would get into saved states
        with self._giving_up.guarded(lambda: step):
            if not self._ready:
                raise self._mismatch("the trainer iterates before it said when densification ends")
            if self._iterations == CHECKED_ITERATIONS:
                self._require_one_backward_each()
            if self._drift is not None and (moved := self._drift.moved()):
                self._release_moved(moved)
                return
            before = self._iteration.step
            if before is not None and step < before and (self._giving_up.in_script or not self._engine.config.enabled):
                self._giving_up.let_go(
                    f"The gate is released: iterations went back from {before} to {step}, as in a second training run "
                    "of one process. Training goes on without it, in all its iterations"
                )
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
        """Decide by this value in the present iteration, instead of by the loss."""
        self._iteration.signal = value

    def event(self, kind: str) -> None:
        """Report a structural change (prune, opacity reset, new optimizer). Changes before training do not count."""
        step = self._iteration.step
        if self._engine.policy is not None and step is not None:
            self._engine.notify_event(kind, step)

    def backward(self, loss: torch.Tensor, run: Callable[[], Any], view: Any = None) -> Any:
        """Gate a training backward pass: call `run()`, which runs it, unless it is skipped."""
        if self.released:
            return run()
        call = Original(run)
        try:
            if not self._is_training_backward():
                return call()
            self._gate(loss, view, call)
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
            if self._backwards >= CHECKED_ITERATIONS:
                raise self._mismatch(f"{self._backwards} training backwards ran in no iteration")
            return False
        now = self._iteration
        now.backwards += 1
        if now.backwards > 1:
            self._odd_iterations += now.backwards == 2
            return False
        self._odd_iterations -= 1
        return True

    def _gate(self, loss: torch.Tensor, view: Any, call: Callable[[], Any]) -> None:
        now = self._iteration
        view = now.view if view is None else view
        if view is None:
            raise self._mismatch("no training view was rendered before the backward")
        if callable(view):
            view = view() if self._engine.active else NOT_READ
        self._engine.gate(view_key(view), loss if now.signal is None else now.signal, call, loss, alone=True)

    # Ways to attach to the trainer.

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
        """Report each call of these methods as a structural change with the method's name."""
        for name in names:
            self.before(owner, name, lambda *args, _kind=name, **kwargs: self.event(_kind))

    def suppress_on_skip(self, owner: Any, *names: str) -> None:
        """Suppress calls of these methods in iterations whose backward pass was skipped.

        For side effects that belong to a gradient step but need no gradient, such as position noise.
        """

        def around(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            return None if self._engine.skipped else original(*args, **kwargs)

        for name in names:
            self.wrap(owner, name, around)

    def loop(
        self,
        names: dict[str, Any],
        *functions: str,
        always: Always | None = None,
        pure: Iterable[str] = (),
        densification: Densification | None = None,
        known: Known | None = None,
    ) -> None:
        """Name the functions whose loop over `range` may be the training loop, so that iterations can be left out.

        Iterations that the loop's own conditions name (`if iteration % 1000 == 0`) always run. Learning-rate schedulers
        of PyTorch are kept where they would be if all iterations ran.

        Args:
            names: Global names of the functions' module; `script_globals` for a script that is about to run.
            functions: Names of the functions.
            always: Returns further iterations out of a range that must run, because functions that the loop calls
                depend on their numbers.
            pure: Functions that only read numbers, and may occur in the loop's conditions.
            densification: How to recognise densification events, if `ready` comes after the loop has begun.
            known: Receives all names of the loop's function right before its conditions are read, and returns values
                of names that the loop assigns, if they are known before.
        """
        pace = self._engine.pace
        if isinstance(pace, Phased):
            pace.describe(always or nothing_always, pure, densification, known or nothing_known)
            replace_range(self._patches, names, functions, pace)
            catch_up_schedulers(self._patches, pace)

    def always(self, always: Always) -> None:
        """Name iterations that must run, as for `loop`, if the loop is the user's own."""
        self._engine.pace.describe(always)

    def require(self, number: int) -> None:
        """Make iteration `number` run, because a condition of the loop depends on an event that just happened.

        Give the name in such a condition a value for which it never holds; see `known` of `loop`.
        """
        self._engine.pace.require(number)

    def optimizer_names(self, named: Named) -> None:
        """Set the function that returns the trainer's optimizers by name. Names identify groups that have none.

        Only the learning rates of these optimizers are scaled.
        """
        self._engine.rates.only = named

    def own_loop(self, owner: Any, name: str, always: Always | None = None) -> None:
        """Use the range that `owner.name(...)` returns as that of the training loop; `always` as for `loop`.

        Only the learning rates of the adapter's `optimizers` are scaled.
        """
        self._engine.rates.only = self._adapter.optimizers
        pace = self._engine.pace
        if not pace.leaves_out:
            return
        pace.describe(always or nothing_always)

        def counted(original: Callable[..., range], *args: Any, **kwargs: Any) -> LoopRange:
            return pace.follow(original(*args, **kwargs), None)

        self.wrap(owner, name, counted)

    def number(self, counted: int) -> int:
        """Return the number of the present iteration in the training loop; `counted` while that loop is not known."""
        number = self._engine.pace.number
        return counted if number is None else number

    @property
    def gap(self) -> int:
        """Number of iterations that were left out right before the present one."""
        return self._engine.pace.gap

    def gate_tensor_backward(self, *callers: str) -> None:
        """Gate the scalar `Tensor.backward` that functions of these names call themselves."""
        intercept_tensor_backward(self._patches, callers, self.backward)

    def check_drift(self, optimizers: Optimizers) -> None:
        """Check that nothing moves the parameters of these optimizers in skipped iterations; see `DriftCheck`.

        A fork of a trainer can do that. The gate is then released, and training goes on without it.
        """
        self._drift = DriftCheck(self._engine, optimizers)

    def _release_moved(self, names: list[str]) -> None:
        self.release(
            f"The loop moved {', '.join(names)} in iteration {self._iteration.step}, whose backward was skipped, by "
            f"code that adapter {self._adapter.name!r} does not know. The gate is detached, and training goes on "
            "without it. Gate this loop by hand with SkipGate(start_iter=...)."
        )

    def on_detach(self, label: str, undo: Callable[[], None]) -> None:
        """Add a function that undoes another change at `detach`."""
        self._patches.add_undo(label, undo)

    @property
    def state(self) -> Engine:
        """Object with `state_dict` and `load_state_dict`, for trainers that save the state of other objects too."""
        return self._engine

    # Questions of the gate.

    @property
    def patched(self) -> list[str]:
        """Every name that is replaced at present."""
        return self._patches.names

    @property
    def trained(self) -> bool:
        """Whether an iteration was seen, or a training backward pass outside of any iteration."""
        return self._iterations + self._backwards > 0

    @property
    def released(self) -> bool:
        """Whether the gate was released, so that training continues without it."""
        return self._giving_up.reason is not None

    def guarded(self) -> AbstractContextManager[None]:
        """Return a block for an adapter's own code. An error in it releases the gate, and the code after it runs.

        Functions that are put around names do not need a block: after an error there, the trainer gets the result that
        it would have without a gate.

        Raises:
            SkipGSError: The gate is on and refuses this run in its first iteration.
        """
        return self._guarded

    def release(self, reason: str) -> None:
        """Release the gate with a reason, so that training continues without it; an error would end the training."""
        self._giving_up.let_go(reason)

    def _failed(self, error: Exception) -> None:
        self._giving_up.on_error(error, self._iteration.step)

    def restore(self) -> None:
        """Restore every replaced name."""
        self._patches.restore()

    def verify(self) -> None:
        """Raise AdapterMismatchError unless training ran, with one training backward per iteration, or without gate."""
        if self.released:
            return
        if self._iterations == 0:
            raise self._mismatch("no iteration of a training loop was seen")
        if self._iterations <= CHECKED_ITERATIONS:
            self._require_one_backward_each()

    def _require_one_backward_each(self) -> None:
        if self._odd_iterations:
            raise self._mismatch(
                f"{self._backwards} training backwards were seen in {self._iterations} iterations, "
                f"where one per iteration was expected"
            )

    def _mismatch(self, what: str) -> AdapterMismatchError:
        return AdapterMismatchError(
            f"The trainer does not behave as expected: {what}. {self._expectation} "
            "Name another adapter, or gate the loop by hand with SkipGate(start_iter=...)."
        )
