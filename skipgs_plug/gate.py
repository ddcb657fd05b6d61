"""SkipGate: the class that users work with."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from skipgs_plug.adapters.registry import find_adapter
from skipgs_plug.core import distributed
from skipgs_plug.core.config import FIELDS, SkipConfig, settings_of
from skipgs_plug.core.engine import Engine
from skipgs_plug.core.errors import GateOrderError, SkipGSError
from skipgs_plug.core.hooks import Adapter, Hooks
from skipgs_plug.core.own_loop import OwnLoop
from skipgs_plug.core.pace.loop_range import LoopRange
from skipgs_plug.core.policy import Policy
from skipgs_plug.core.report import build_report, counters, summarise
from skipgs_plug.core.trace import TraceRow
from skipgs_plug.core.trainer_info import TrainerInfo


class SkipGate:
    """Shortens the training of 3D Gaussians from outside, without editing the trainer.

    There are two ways to use it. For a known trainer (an object, a train module, or a training function):

        gate = SkipGate(runner, share="auto")
        runner.train()  # unchanged
        print(gate.summary())

    For any other loop, call its verbs, as with `torch.amp.GradScaler`; see the examples.

    There are three policies. `share` leaves out whole iterations of the whole run, densification included, and larger,
    shrinking steps make up for them. `refine_share` does the same after densification only. Without either, the gate
    follows the paper (SkipGS, arXiv 2603.08997): every forward pass runs, and the backward pass of a view is skipped
    while its loss is at or below its own running mean.

    Learning-rate and SH schedules, logging and checkpoints count iterations, not updates: let them run in skipped
    iterations too. Where the decision depends on the loss, the gate reads it before the backward pass. That is one
    device sync per iteration; most trainers read the loss anyway, after the backward pass.

    As a context manager, the gate detaches at the end of the block, after an exception too.

    Args:
        trainer: The trainer to attach to. None for a loop of your own, or, with `adapter`, for a training script
            that will run in this process.
        adapter: Name of the adapter, when the gate does not find the right one by itself.
        config: All settings in one object, instead of `config_fields`.
        policy: An instance of a subclass of `skipgs_plug.core.policy.Policy`, used instead of `SkipPolicy`.
        record_trace: Keep every decision in `trace`.
        **config_fields: Fields of `SkipConfig`.

    Raises:
        UnknownTrainerError: No adapter knows the trainer.
        AdapterMismatchError: The trainer lacks an attribute that its adapter needs.
        SkipGSError: A setting is out of range, `policy` is not a `Policy`, or the trainer has a gate already.

    Examples:
        The paper's gate in a loop of your own. The first visits of a view always run; later the floor
        `min_bwd_ratio` bounds how many backward passes are skipped.

        >>> import torch
        >>> from skipgs_plug import SkipGate
        >>> weight = torch.nn.Parameter(torch.zeros(1))
        >>> optimizer = torch.optim.Adam([weight], lr=0.1)
        >>> gate = SkipGate(start_iter=0, warmup=4)
        >>> for step in range(200):
        ...     loss = (weight - 1).square().mean()
        ...     if gate.backward(loss, view=f"view_{step % 2}.png", step=step):
        ...         optimizer.step()
        ...         optimizer.zero_grad(set_to_none=True)
        >>> stats = gate.stats()
        >>> stats["backwards_run"] + stats["backwards_skipped"]
        200
        >>> stats["backwards_skipped"] > 50
        True
    """

    def __init__(
        self,
        trainer: Any = None,
        *,
        adapter: str | Adapter | None = None,
        config: SkipConfig | None = None,
        policy: Policy | None = None,
        record_trace: bool = False,
        **config_fields: Any,
    ) -> None:
        settings = settings_of(config, config_fields)
        if not (policy is None or isinstance(policy, Policy)):
            raise SkipGSError(
                f"{type(policy).__name__} is not a policy; derive it from skipgs_plug.core.policy.Policy."
            )
        self._hooks: Hooks | None = None
        self._adapter: Adapter | None = None
        if trainer is not None or adapter is not None:
            found = find_adapter(trainer, adapter) if adapter is None or isinstance(adapter, str) else adapter
            self._adapter = found
            self._engine = Engine(settings, policy, record_trace, found.must_run, found.saved_state)
            self._attach(trainer, found, FIELDS if config is not None else frozenset(config_fields))
        elif settings.start_iter is None and policy is None and settings.enabled:
            raise SkipGSError("SkipGate needs a trainer, or start_iter=, the iteration at which densification ends.")
        else:
            self._engine = Engine(settings, policy, record_trace)
            self._engine.configure(TrainerInfo(0 if policy is None else policy.start_iter))
        self._loop = OwnLoop(self._engine)

    # Verbs for a loop of your own.

    def iterations(
        self,
        numbers: range,
        *,
        always: Iterable[int] | None = None,
        views: Iterable[Any] | None = None,
        events: Iterable[int] | None = None,
        resets: Iterable[int] | None = None,
    ) -> LoopRange:
        """Return the iterations of your loop that run: `for step in gate.iterations(range(30_000))`.

        It also works for your own loop around a trainer that the gate is attached to.

        Some iterations always run: the last one, and every iteration whose number fulfils a condition of your loop,
        such as `if step % 1000 == 0`. The gate reads the conditions from the source of the loop, and of your own
        functions that the loop calls with the number. PyTorch's schedulers that the loop steps in this thread are
        stepped for left-out iterations too. Set a scheduler of your own to the number of the iteration.

        Args:
            numbers: All iterations of the run, or all remaining ones, as a range with step 1. A run may have several
                parts, one after the other; the part in which refinement begins then goes on to the last iteration.
            always: Iterations that always run besides those. Conditions that the gate cannot evaluate in advance are no
                error then.
            views: Keys of all training views. `share="auto"` and `refine_share="auto"` need them.
            events: Iterations in which your loop densifies, such as `range(600, 15_000, 100)`. `share` leaves out
                some of them.
            resets: Iterations in which your loop resets opacities; an empty list if it never does. `share` then takes
                longer steps. None if they are unknown.

        Raises:
            SkipGSError: `numbers` is not a range with step 1, or `resets` comes without `events`. Before training has
                begun, the gate also raises it if `numbers` goes beyond the plan of an earlier call, or if a condition
                of the loop cannot be evaluated in advance and `always` is not given. During training, these two
                problems release the gate.

        Examples:
            Four of ten iterations run after densification, which ends here at iteration 10. The last one always runs.

            >>> from skipgs_plug import SkipGate
            >>> gate = SkipGate(start_iter=10, refine_share=0.4)
            >>> list(gate.iterations(range(20), always=[15]))
            [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 15, 19]
        """
        frame = sys._getframe(1)
        source = (frame.f_code, {**frame.f_globals, **frame.f_locals})
        return self._loop.iterations(numbers, source, always, views, events, resets)

    def backward(self, loss: Any, view: Any, step: int, *, signal: Any = None) -> bool:
        """Run `loss.backward()`, or skip it; return True when gradients were computed.

        Args:
            loss: Scalar loss of this view, or a list of per-view losses with a list of keys as `view`. For a list,
                the gate decides on each view separately, and one backward pass runs on the sum of the kept losses.
            view: Stable key of the view: image name or index. For a joint loss of a batch, one constant key.
            step: Iteration, counted like `start_iter`.
            signal: Value (or list of values) to decide by, when it is not the loss itself, such as the image term.
                A loss that `torch.amp.GradScaler` has scaled counts with its value before that.

        Raises:
            GateOrderError: In the first iteration, `backward` was already called for this view, or `update` or `step`
                was called before it, or the next number is smaller.
            SkipGSError: The loss is not a tensor, or it is not finite and `on_nonfinite` is "raise". The first
                iteration also raises it if the key is not usable, or if a share is given and the loop does not run over
                `iterations`. In later iterations, both errors release the gate with a warning, like any other error
                of the gate itself; see `released`. Losses that stay non-finite are an error in any iteration.

        Examples:
            A batch of two views in one iteration:

            >>> import torch
            >>> from skipgs_plug import SkipGate
            >>> weight = torch.nn.Parameter(torch.ones(2))
            >>> gate = SkipGate(start_iter=0)
            >>> gate.backward([weight[0] ** 2, weight[1] ** 2], view=["a.png", "b.png"], step=0)
            True
            >>> weight.grad
            tensor([2., 2.])
        """
        self._require_manual("backward")
        return self._loop.backward(loss, view, step, loss if signal is None else signal)

    def step(self, optimizer: Any, *args: Any) -> bool:
        """Call `optimizer.step(*args)` if a gradient is pending; return True when it stepped.

        A gradient is pending if no step has used it yet. It was computed in this iteration or, in a loop that
        accumulates gradients, in an earlier one. Zero the gradients only when True is returned, with
        `set_to_none=True`.

        Args:
            optimizer: One optimizer, or a list or dict of all that step together.
            *args: Arguments of `optimizer.step`, such as the mask of visible Gaussians for a sparse optimizer.

        Raises:
            GateOrderError: In the first iteration, `backward` was not called first, or the optimizer has stepped. In
                later iterations, this releases the gate.
        """
        self._require_manual("step")
        return self._loop.step(optimizer, *args)

    def update(self) -> None:
        """End the iteration and free the graph of a skipped backward pass.

        This call is optional: a new step number ends the iteration too. In most loops, however, the next forward pass
        has run by then, so that two graphs are in memory at once.

        Raises:
            GateOrderError: In the first iteration, `backward` was not called first. In later iterations, this releases
                the gate.
        """
        self._require_manual("update")
        self._loop.update()

    def notify_event(self, kind: str, step: int | None = None) -> None:
        """Report a structural change. The gate then skips no backward pass for a while and keeps the means as they are.

        Args:
            kind: Name of the change for the report, such as "prune" or "opacity reset".
            step: Iteration of the change; None for the current one.

        Raises:
            GateOrderError: No iteration has run yet and `step` is not given.
        """
        if self.released is not None:
            return
        step = self._engine.iteration.step if step is None else int(step)
        if step is None or self._engine.policy is None:
            raise GateOrderError("notify_event() came before the first iteration; give its step.")
        with self._loop.guarded:
            self._engine.notify_event(kind, step)

    # Counts and settings.

    @property
    def released(self) -> str | None:
        """Why the gate released a run, which then trained on without it; None if it did not."""
        return self._engine.release.reason

    @property
    def skipped(self) -> bool:
        """Whether the backward pass of the current iteration was skipped."""
        return self._engine.skipped

    @property
    def config(self) -> SkipConfig:
        """Settings in force, completed by the adapter."""
        return self._engine.config

    @property
    def policy(self) -> Policy | None:
        """The policy in force; None until an adapter knows when densification ends."""
        return self._engine.policy

    @property
    def adapter(self) -> Adapter | None:
        """The attached adapter; None for a loop of your own."""
        return self._adapter

    @property
    def trace(self) -> list[TraceRow]:
        """One row per decision.

        Raises:
            SkipGSError: The gate was created without `record_trace=True`.
        """
        if self._engine.trace is None:
            raise SkipGSError("This gate records no trace; create it with record_trace=True.")
        return self._engine.trace

    @property
    def script_globals(self) -> dict[str, Any]:
        """Names that `skipgs-plug run` puts among the globals of a script before it runs the script."""
        return {} if self._hooks is None else self._hooks.script_globals

    @property
    def patched(self) -> list[str]:
        """Every name that was replaced in the trainer and in PyTorch, as "owner.name"; empty after `detach`.

        A loop over `iterations` replaces `step` of PyTorch's schedulers while it runs, which the list does not hold.
        Under `skipgs-plug run` the list also holds the names that are replaced while the script runs: `torch.save`,
        `torch.load` (with `weights_only=False` unless the script sets it) and, with `--cpu`, names of `torch.cuda`.
        """
        own = self._loop.patches.names if self._hooks is None else self._hooks.patched
        return [*own, *self._adapter.replaced] if own and self._adapter is not None else own

    def stats(self) -> dict[str, Any]:
        """Counters, and times in seconds, under their names in skipgs.json; see `skipgs_plug.core.report`."""
        own = None if self.adapter is None else self.adapter.timing()
        times = self._engine.clock.times if own is None else own
        return counters(self._engine.stats, self._floor, times, self._engine.pace.report(), self.released)

    def report(self) -> dict[str, Any]:
        """The content of skipgs.json: settings, counters, seconds, per-view table."""
        settings = {**self.config.as_dict(), "adapter": None if self.adapter is None else self.adapter.name}
        return build_report(settings, self.stats(), self.view_table())

    def view_table(self) -> list[dict[str, Any]]:
        """One row per view since `start_iter`, with `view visits backwards skips mean_loss last_loss`."""
        return self._engine.stats.view_table(self._engine.mean)

    def scalars(self) -> dict[str, float]:
        """Return numbers for a logger, under keys "skipgs/..."; it may be called in any iteration."""
        scalars = self._engine.stats.scalars()
        scalars["skipgs/skipped"] = float(self.skipped)
        scalars["skipgs/floor"] = self._floor or 0.0
        return scalars

    def summary(self) -> str:
        """Return a few lines that say how much was skipped and why."""
        return summarise(self.config, self.stats())

    # State and attachment.

    def state_dict(self) -> dict[str, Any]:
        """Return the state from which `load_state_dict` continues exactly: plain values with string keys.

        Save it at the end of an iteration, beside the trainer's own checkpoint.

        Returns:
            `version` (2), `policy` (see `SkipPolicy.state_dict`), `stats` (counts, per-view rows),
            `non_finite_in_a_row`, `clock` (seconds), `step` (last iteration, None before the first). The dictionary
            is empty until an adapter knows when densification ends.
        """
        return self._engine.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict()`, or from a state of the authors' controller (version 1).

        A state of another scene with the same view names is noticed later: if the first ten losses are all far from
        the means of their views, the gate is released at the tenth. A gate that is off ignores the state of a share.

        Args:
            state: Result of `state_dict()`.

        Raises:
            SkipGSError: The state is damaged, has another version, or belongs to another scene.
        """
        self._engine.load_state_dict(state)

    @property
    def trained(self) -> bool:
        """Whether training has begun: an iteration or a backward pass was seen."""
        return self._engine.iteration.step is not None if self._hooks is None else self._hooks.trained

    def verify(self) -> None:
        """Raise AdapterMismatchError unless the attached trainer ran one training backward pass per iteration.

        The gate checks the first ten iterations by itself. Call this after a run that may have been shorter.
        """
        if self._hooks is not None:
            self._hooks.verify()

    def detach(self) -> None:
        """Restore everything that was replaced. Counters and summary stay readable."""
        if self._hooks is not None:
            self._hooks.restore()
        self._loop.patches.restore()
        self._engine.remove()

    def __enter__(self) -> SkipGate:
        return self

    def __exit__(self, *exception: object) -> None:
        self.detach()

    @property
    def _floor(self) -> float | None:
        return None if self.policy is None else self.policy.floor

    def _attach(self, trainer: Any, adapter: Adapter, given: frozenset[str]) -> None:
        self._hooks = Hooks(self._engine, adapter, given, in_script=trainer is None)
        try:
            if trainer is None:
                adapter.attach_script(self._hooks)
            else:
                distributed.refuse_unreachable_ranks()
                adapter.attach(self._hooks)
        except BaseException as error:
            if isinstance(error, Exception) and not isinstance(error, SkipGSError):
                self._engine.release.on_error(error, None)  # not foreseen, so the trainer runs without a gate
                return
            self._hooks.restore()
            raise

    def _require_manual(self, verb: str) -> None:
        if self._adapter is not None:
            raise GateOrderError(
                f"{verb}() is for loops of your own; this gate is attached by adapter {self._adapter.name!r}, "
                f"so leave out the call of {verb}()."
            )
