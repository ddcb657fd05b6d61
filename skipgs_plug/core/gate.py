"""SkipGate: the one object a user meets."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from skipgs_plug.core import adapter as adapters
from skipgs_plug.core import decision, distributed
from skipgs_plug.core.clock import GateClock
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.errors import GateOrderError, SkipGSError
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.nonfinite import NonFiniteGuard
from skipgs_plug.core.optimizers import OptimizerSteps, listed
from skipgs_plug.core.policy import Policy, SkipPolicy
from skipgs_plug.core.report import build_report
from skipgs_plug.core.state import GATE_VERSION, gate_state, is_release_state
from skipgs_plug.core.stats import GateStats
from skipgs_plug.core.trace import TraceRow
from skipgs_plug.core.views import require_unique, view_key

log = logging.getLogger(__name__)

# Optimizers step at once in these iterations even when gradients are accumulated otherwise.
_STEP_AT_ONCE = frozenset({"inactive", "warm-up", "pause"})


class SkipGate:
    """Leaves out backwards that a 3DGS trainer does not need after densification (SkipGS).

    Two entrances, one engine. For a known trainer (an object, a train module, or a training function):

        gate = SkipGate(runner)
        runner.train()                  # unchanged
        print(gate.summary())

    For any other loop, verbs as in `torch.amp.GradScaler`:

        gate = SkipGate(start_iter=15_000)
        for step in range(1, 30_001):
            ...
            if gate.backward(loss, view=camera.image_name, step=step):
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)

    Learning-rate and SH schedules, logging and checkpoints count iterations, not updates: let them run on
    skipped iterations too. From `start_iter` on the loss is read on the host before the backward, one
    device sync per iteration; most trainers read it anyway, just later.

    Used as a context manager the gate detaches at the end of the block, on exceptions too.

    Args:
        trainer: What to attach to. None for a loop of your own, or, with `adapter`, for a training script
            that is about to be run in this process.
        adapter: Name of an adapter, when the right one is not found by itself.
        config: All settings in one object, instead of `config_fields`.
        policy: Decides in place of `SkipPolicy`; see `skipgs_plug.core.policy.Policy`.
        record_trace: Keep every gated decision in `trace`.
        **config_fields: Fields of `SkipConfig`.

    Attributes:
        config: settings in force, completed by the adapter.
        adapter: the adapter that is attached, None for a loop of your own.
        policy: the policy, None until an adapter knows when densification ends.
        trace: `TraceRow` per gated decision, when recorded.

    Raises:
        UnknownTrainerError: No adapter knows the trainer.
        AdapterMismatchError: The trainer lacks something that its adapter needs.
        SkipGSError: A setting is out of range, or the trainer is gated already.
    """

    def __init__(
        self,
        trainer: Any = None,
        *,
        adapter: str | adapters.Adapter | None = None,
        config: SkipConfig | None = None,
        policy: Policy | None = None,
        record_trace: bool = False,
        **config_fields: Any,
    ) -> None:
        self.config = _settings(config, config_fields)
        self._given = set(config_fields) if config is None else set(_FIELDS)
        self.policy: Policy | None = policy
        self.trace: list[TraceRow] = []
        self._record_trace = record_trace
        self._stats = GateStats()
        self._clock = GateClock()
        self._guard = NonFiniteGuard(self.config.on_nonfinite)
        self._steps = OptimizerSteps(self.config)
        self._start = 0
        self._view_names: list[str] | None = None
        self._pending_state: dict[str, Any] | None = None
        self._ranks_checked = False
        # The present iteration.
        self._step: int | None = None
        self._decision: Decision = decision.INACTIVE
        self._ran = False
        self._views_now: set[str] = set()
        self._stepped: set[int] = set()
        self._updated = False

        self.adapter: adapters.Adapter | None = None
        self._hooks: Hooks | None = None
        if trainer is not None or adapter is not None:
            self._attach(trainer, adapter)
        elif self.config.start_iter is None and policy is None and self.config.enabled:
            raise SkipGSError("SkipGate needs a trainer, or start_iter=, the iteration at which densification ends.")
        else:
            self._configure(getattr(policy, "start_iter", 0), None, None, None, {})

    # Verbs for a loop of your own.

    def backward(self, loss: Any, view: Any, step: int, *, signal: float | Tensor | None = None) -> bool:
        """Run `loss.backward()` unless this view can do without; True when gradients were computed.

        Args:
            loss: Scalar loss of this view. Or a list of per-view losses, with a list of keys as `view`:
                each is decided on by itself, and one backward runs on the sum of those that stay.
            view: Stable key of the view: image name, or index. One constant key for a joint loss of a batch.
            step: Iteration, in the same counting as `start_iter`.
            signal: Value to decide on when it is not the loss itself: the image term, or the loss before
                an AMP scaler.

        Raises:
            GateOrderError: The view was decided on already in this iteration, the iteration was ended by
                `update`, or iterations go backwards.
            SkipGSError: The key is not usable, or losses stay non-finite.
        """
        self._require_manual("backward")
        step = int(step)
        if step != self._step:
            self._open_iteration(step)
        elif self._updated or self._stepped:
            verb = "update" if self._updated else "step"
            raise GateOrderError(
                f"backward() was called after {verb}() in iteration {step}; all backwards of an iteration "
                "come first, and each iteration has its own step number."
            )
        if isinstance(view, list):
            return self._backward_batch(loss, view, signal)
        key = self._new_in_iteration(view)
        return self._decide_and_run(loss, key, loss.backward, signal)

    def step(self, optimizer: Any, *args: Any) -> bool:
        """Call `optimizer.step(*args)` if it has a pending gradient; True when it stepped.

        Pending means computed and not yet used, in this iteration or, where gradients are accumulated, an
        earlier one. Zero the gradients only when True is returned, and with `set_to_none=True`.

        Args:
            optimizer: One optimizer, or a list or dict of all that step together. With
                `step_mode="adaptive_norm"` give all in one call.
            *args: Passed on. For sparse optimizers see `visible`.

        Raises:
            GateOrderError: No `backward` came first in this iteration, or the optimizer was stepped in it.
        """
        self._require_manual("step")
        if self._step is None or self._updated or not self._views_now:
            raise GateOrderError("step() was called before backward() in this iteration.")
        optimizers = listed(optimizer)
        for one in optimizers:
            if id(one) in self._stepped:
                raise GateOrderError("step() was called twice for one optimizer in this iteration.")
        self._stepped.update(id(one) for one in optimizers)
        return self._steps.step(optimizers, args, self._ran, self._step_at_once)

    def update(self) -> None:
        """End the iteration. Optional: a new step number ends it too.

        Raises:
            GateOrderError: No `backward` came first in this iteration.
        """
        self._require_manual("update")
        if self._step is None or self._updated or not self._views_now:
            raise GateOrderError("update() was called before backward() in this iteration.")
        self._updated = True

    def visible(self, mask: Any) -> Any:
        """Return the visibility mask that a sparse optimizer must step with: `gate.step(opt, gate.visible(m), N)`.

        With accumulated gradients it is the union over all backwards since the last step, else the mask.

        Args:
            mask: This iteration's mask, bool  # [N]
        """
        if not self._steps.accumulating:
            return mask
        if self._ran:
            return self._steps.accumulator.see(mask)
        return mask if self._steps.accumulator.visible is None else self._steps.accumulator.visible

    def notify_event(self, kind: str, step: int | None = None) -> None:
        """Tell of a structural change: real backwards follow for a while, and means are left alone.

        Args:
            kind: What happened ("prune", "opacity reset"), for the report.
            step: Iteration it happened in; the present one when left out.

        Raises:
            GateOrderError: No iteration was seen yet and no step is given.
        """
        step = self._step if step is None else step
        if step is None or self.policy is None:
            raise GateOrderError("notify_event() came before the first iteration; give its step.")
        if not self.config.enabled or step < self._start - 1:
            return
        self._stats.events[kind] = self._stats.events.get(kind, 0) + 1
        self.policy.notify_event(step, self._n_views)
        self._steps.accumulator.reset(stepped=False)

    # What was done.

    @property
    def skipped(self) -> bool:
        """Whether the present iteration's backward was skipped."""
        return self._step is not None and self._decision.skip and not self._ran

    @property
    def patched(self) -> list[str]:
        """Every name replaced in the trainer and in PyTorch, as "owner.name"."""
        return [] if self._hooks is None else self._hooks.patched

    def stats(self) -> dict[str, Any]:
        """Counters, by the names of skipgs.json; see `skipgs_plug.core.report`."""
        report = self.report()
        return {name: report[name] for name in report if name not in ("settings", "views", "schema_version")}

    def report(self) -> dict[str, Any]:
        """The content of skipgs.json: settings, counters, seconds, per-view table."""
        t_total, t_post = self._timing()
        return build_report(
            settings={**self.config.as_dict(), "adapter": self.adapter.name if self.adapter else None},
            stats=self._stats,
            floor=getattr(self.policy, "floor", None),
            t_total=t_total,
            t_post=t_post,
            views=self.view_table(),
        )

    def view_table(self) -> list[dict[str, Any]]:
        """One row per view seen since `start_iter`: `view visits backwards skips mean_loss last_loss`."""
        return self._stats.view_table(self._mean)

    def scalars(self) -> dict[str, float]:
        """A flat dict of numbers for a logger, keys "skipgs/...": call it at any iteration."""
        stats = self._stats
        return {
            "skipgs/skipped": float(self.skipped),
            "skipgs/skip_ratio": stats.skip_ratio,
            "skipgs/backwards": float(stats.backwards),
            "skipgs/skips": float(stats.skips),
            "skipgs/floor": float(getattr(self.policy, "floor", 0.0)),
            "skipgs/paused": float(stats.reasons.get("pause", 0)),
            "skipgs/non_finite": float(stats.reasons.get("non-finite", 0)),
        }

    def summary(self) -> str:
        """What the gate did, in a few lines for people."""
        stats, reasons = self._stats, self._stats.reasons
        floor = getattr(self.policy, "floor", None)
        lines = [
            f"SkipGS: {stats.skips:,} of {stats.gated:,} backwards skipped since iteration {self._start:,} "
            f"({100 * stats.skip_ratio:.1f} %), {stats.iterations:,} iterations in all.",
            f"  floor {'none' if floor is None else f'{floor:.3f}'}, "
            f"warm-up {reasons.get('warm-up', 0):,}, paused {reasons.get('pause', 0):,}, "
            f"held back by the floor {reasons.get('budget', 0):,}, "
            f"non-finite {reasons.get('non-finite', 0):,}, events {sum(stats.events.values()):,}",
        ]
        if not self.config.enabled:
            lines[0] = f"SkipGS: off, {stats.iterations:,} iterations seen."
        return "\n".join(lines)

    # State.

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to go on as if never interrupted: plain values with string keys.

        Save it after an iteration, beside the trainer's own checkpoint.

        Returns:
            `version` (2), `policy` (see `SkipPolicy.state_dict`), `stats` (counts, per-view rows),
            `accumulator` (norms of single gradients), `non_finite_in_a_row`, `clock` (seconds), `step` (last
            iteration, None before the first).
        """
        if self.policy is None or self._pending_state is not None:
            return dict(self._pending_state or {})
        self._clock.mark()
        return {
            "version": GATE_VERSION,
            "policy": self.policy.state_dict(),
            "stats": self._stats.state_dict(),
            "accumulator": self._steps.accumulator.state_dict(),
            "non_finite_in_a_row": self._guard.in_a_row,
            "clock": self._clock.state_dict(),
            "step": self._step,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict()`, or from a state of the authors' controller (version 1).

        Raises:
            SkipGSError: The state is damaged, of another version, or of another scene.
        """
        if not state:
            raise SkipGSError("The gate state is empty: it was saved before training began; start afresh.")
        if self.policy is None:
            self._pending_state = dict(state)
            return
        self._pending_state = None
        if is_release_state(state):
            self._refuse_other_scene(state.get("view_loss_ema", ()))
            self.policy.load_state_dict(state)
            self._stats.load_release_state(state)
            self._steps.accumulator.load_release_state(state)
            self._step = None
        else:
            state = gate_state(state)
            self._refuse_other_scene(state["stats"]["views"])
            self.policy.load_state_dict(state["policy"])
            self._stats.load_state_dict(state["stats"])
            self._steps.accumulator.load_state_dict(state["accumulator"])
            self._guard.in_a_row = state["non_finite_in_a_row"]
            self._clock.load_state_dict(state["clock"])
            self._step = state["step"]
        self._begin_iteration()

    # Attachment.

    def verify(self) -> None:
        """Raise AdapterMismatchError unless the attached trainer ran one training backward per iteration.

        The first ten iterations are checked anyway; call it after a run that may have been shorter.
        """
        if self._hooks is not None:
            self._hooks.verify()

    def detach(self) -> None:
        """Put back everything that was replaced; counts and summary stay readable."""
        if self._hooks is not None:
            self._hooks.restore()

    def __enter__(self) -> SkipGate:
        return self

    def __exit__(self, *exception: object) -> None:
        self.detach()

    def _attach(self, trainer: Any, adapter: str | adapters.Adapter | None) -> None:
        if adapter is None or isinstance(adapter, str):
            adapter = adapters.find(trainer, adapter)
        self.adapter = adapter
        self._hooks = Hooks(self, adapter.name, adapter.checked)
        try:
            if trainer is None:
                adapter.attach_script(self._hooks)
            else:
                distributed.refuse_unreachable_ranks()
                adapter.attach(self._hooks)
        except BaseException:
            self._hooks.restore()
            raise

    def _configure(
        self,
        start_iter: int | None,
        view_names: Iterable[str] | None,
        max_steps: int | None,
        world_size: int | None,
        defaults: dict[str, Any],
    ) -> None:
        """Complete the settings with what is known of the trainer, and make the policy."""
        if world_size is not None:
            distributed.refuse_unreachable_ranks(world_size)
        suggested = {name: value for name, value in defaults.items() if name not in self._given}
        if self.config.start_iter is None:
            suggested["start_iter"] = start_iter
        self.config = config = dataclasses.replace(self.config, **suggested)
        if config.start_iter is None:
            if config.enabled:
                raise SkipGSError(
                    "This trainer does not densify, so the gate cannot know when to begin; give start_iter=."
                )
            self.config = config = dataclasses.replace(config, start_iter=0)
        self._start = int(config.start_iter or 0)
        if view_names is not None:
            self._view_names = require_unique(view_names)
        if config.enabled and max_steps is not None and self._start > max_steps:
            log.warning("The gate starts at %d, after the last iteration %d.", self._start, max_steps)
        if self.policy is None:
            self.policy = SkipPolicy(
                start_iter=self._start,
                threshold=config.threshold,
                ema_decay=config.ema_decay,
                warmup=config.warmup,
                min_bwd_ratio=config.min_bwd_ratio,
                enabled=config.enabled,
                pause_iters=config.pause_iters,
            )
        if self._pending_state is not None:
            self.load_state_dict(self._pending_state)

    # One iteration.

    def _open_iteration(self, step: int) -> None:
        if self._step is not None and step < self._step:
            raise GateOrderError(
                f"Iterations went back from {self._step} to {step}: load the gate state that belongs to "
                "the checkpoint, or attach a new gate."
            )
        self._step = step
        self._begin_iteration()
        self._clock.open(post=step >= self._start)
        if self._steps.accumulating and self._hooks is not None and self.adapter is not None:
            self._steps.attach(self._hooks, self.adapter.optimizers, lambda: (self._ran, self._step_at_once))

    def _begin_iteration(self) -> None:
        self._steps.begin_iteration()
        self._decision = decision.INACTIVE
        self._ran = False
        self._views_now.clear()
        self._stepped.clear()
        self._updated = False

    def _gate_backward(self, loss: Tensor, view: Any, run: Callable[[], Any], signal: float | Tensor | None) -> None:
        """The trainer's own backward of the present iteration."""
        self._decide_and_run(loss, view_key(view), run, signal)

    def _decide_and_run(self, loss: Tensor, view: str, run: Callable[[], Any], signal: float | Tensor | None) -> bool:
        self._decision = self._decide(loss if signal is None else signal, view)
        if not self._decision.skip:
            run()
            self._ran = True
        self._clock.mark()
        return not self._decision.skip

    def _backward_batch(self, losses: Any, views: list[Any], signal: Any) -> bool:
        if len(losses) != len(views) or (signal is not None and len(signal) != len(views)):
            raise SkipGSError(f"{len(views)} view keys came with {len(losses)} losses; give one loss per view.")
        keys = [self._new_in_iteration(view) for view in views]
        signals = losses if signal is None else signal
        answers = [self._decide(value, key) for value, key in zip(signals, keys, strict=True)]
        kept = [loss for loss, answer in zip(losses, answers, strict=True) if not answer.skip]
        if kept:
            torch.stack(kept).sum().backward()
            self._ran = True
        self._decision = next((answer for answer in answers if not answer.skip), answers[-1])
        self._clock.mark()
        return bool(kept)

    def _decide(self, signal: float | Tensor, view: str) -> Decision:
        """Decide on one view in the present iteration, with all processes, and record it."""
        assert self.policy is not None and self._step is not None
        self._stats.iterations += 1
        step = self._step
        if not self.config.enabled or step < self._start:
            return decision.INACTIVE
        loss = float(signal.detach() if isinstance(signal, Tensor) else signal)
        mean = self._mean(view) if self._record_trace else None
        answer = self._agreed_decision(view, loss, step)
        self._stats.record(answer, view, loss)
        if self._record_trace:
            self.trace.append(TraceRow(step, view, loss, mean, answer.reason, answer.skip))
        return answer

    def _agreed_decision(self, view: str, loss: float, step: int) -> Decision:
        if distributed.group_size() == 1:
            if not self._ranks_checked:
                distributed.refuse_unreachable_ranks()
                self._ranks_checked = True
            return self._own_decision(view, loss, step)
        try:
            own = self._own_decision(view, loss, step)
        except SkipGSError:
            distributed.abort()
            raise
        answer = distributed.agree(own)
        overrule = getattr(self.policy, "overrule_skip", None)
        if answer is decision.OTHER_RANK and overrule is not None:
            overrule()
        return answer

    def _own_decision(self, view: str, loss: float, step: int) -> Decision:
        assert self.policy is not None
        if loss - loss != 0.0:  # NaN or infinite
            return self._guard.answer(view, loss, step, self._mean(view), self._n_views)
        self._guard.in_a_row = 0
        if self.adapter is not None and self.adapter.must_run(step):
            return decision.FORCED
        return self.policy.decide(view, loss, step)

    def _new_in_iteration(self, view: Any) -> str:
        key = view_key(view)
        if key in self._views_now:
            raise GateOrderError(
                f"backward() was called twice for view {key!r} in iteration {self._step}; "
                "give each iteration its own step number."
            )
        self._views_now.add(key)
        return key

    def _notify_event_now(self, kind: str) -> None:
        """A structural change in the trainer; before training it is part of setting up."""
        if self.policy is not None and self._step is not None:
            self.notify_event(kind)

    def _mean(self, view: str) -> float | None:
        return self.policy.means.get(view) if isinstance(self.policy, SkipPolicy) else None

    def _timing(self) -> tuple[float, float]:
        own = None if self.adapter is None else self.adapter.timing()
        return (self._clock.t_total, self._clock.t_post) if own is None else own

    def _refuse_other_scene(self, views: Iterable[str]) -> None:
        if self._view_names is None:
            return
        unknown = sorted({str(view) for view in views} - set(self._view_names))
        if unknown:
            raise SkipGSError(
                f"The gate state belongs to another scene: it knows view {unknown[0]!r}, which is not among "
                f"the {len(self._view_names)} training views; start the gate afresh."
            )

    def _require_manual(self, verb: str) -> None:
        if self._hooks is not None and self.adapter is not None:
            raise GateOrderError(
                f"{verb}() is for loops of your own; this gate is attached by adapter {self.adapter.name!r}, "
                "and the trainer calls its own."
            )

    @property
    def _n_views(self) -> int:
        return self._stats.n_views if self._view_names is None else len(self._view_names)

    @property
    def _step_at_once(self) -> bool:
        return self._decision.reason in _STEP_AT_ONCE


_FIELDS = tuple(field.name for field in dataclasses.fields(SkipConfig))


def _settings(config: SkipConfig | None, fields: dict[str, Any]) -> SkipConfig:
    unknown = sorted(set(fields) - set(_FIELDS))
    if unknown:
        raise SkipGSError(f"There is no setting {unknown[0]!r}; the settings are {', '.join(_FIELDS)}.")
    if config is None:
        return SkipConfig(**fields)
    if fields:
        raise SkipGSError(f"Give either config= or {', '.join(fields)}, not both.")
    return config
