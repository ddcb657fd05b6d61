"""What happens in one gated iteration, whoever drives it: verbs by hand, or an adapter's hooks."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Iterable
from typing import Any

from torch import Tensor

from skipgs_plug.core import decision, distributed
from skipgs_plug.core.adapter import Adapter
from skipgs_plug.core.clock import GateClock
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.errors import GateOrderError, SkipGSError
from skipgs_plug.core.nonfinite import NonFiniteGuard
from skipgs_plug.core.optimizers import OptimizerSteps
from skipgs_plug.core.policy import Policy, SkipPolicy
from skipgs_plug.core.scene_check import SceneCheck
from skipgs_plug.core.state import GATE_VERSION, gate_state, is_release_state, require_state
from skipgs_plug.core.stats import GateStats
from skipgs_plug.core.trace import TraceRow
from skipgs_plug.core.views import require_unique

log = logging.getLogger(__name__)

# Optimizers step at once in these iterations even when gradients are accumulated otherwise.
STEP_AT_ONCE = frozenset({"inactive", "warm-up", "pause"})


class Engine:
    """Decides, runs or skips, counts; holds all state of a gate.

    Attributes:
        config: settings in force.
        adapter: answers about the trainer, None for a loop driven by hand.
        policy: None until `configure` was called.
        start: first iteration that may be skipped.
        step: present iteration, None before the first.
        ran: a real backward ran in the present iteration.
        stats, clock, steps: counts, seconds, optimizer steps.
        trace: rows of gated decisions; None when they are not recorded.
    """

    def __init__(self, config: SkipConfig, policy: Policy | None, record_trace: bool) -> None:
        self.config = config
        self.adapter: Adapter | None = None
        self.policy = policy
        self.start = 0
        self.step: int | None = None
        self.ran = False
        self.stats = GateStats()
        self.clock = GateClock()
        self.steps = OptimizerSteps(config)
        self.trace: list[TraceRow] | None = [] if record_trace else None
        self._guard = NonFiniteGuard(config.on_nonfinite)
        self._decision: Decision = decision.INACTIVE
        self._view_names: list[str] | None = None
        self._pending_state: dict[str, Any] | None = None
        self._ranks_checked = False
        self._asked_for_state = False
        self._scene_check = SceneCheck()

    def configure(
        self,
        start_iter: int | None,
        view_names: Iterable[str] | None = None,
        max_steps: int | None = None,
        world_size: int | None = None,
        gradients_read_until: int | None = None,
        defaults: dict[str, Any] | None = None,
    ) -> None:
        """Complete the settings with what is known of the trainer, and make the policy.

        Args:
            start_iter: Used when the settings give none.
            view_names: Keys of all training views.
            max_steps: Last iteration.
            world_size: Number of processes.
            gradients_read_until: No skip may happen before this iteration.
            defaults: Further settings to replace.

        Raises:
            SkipGSError: Nothing says when to begin, the settings begin too early, view names repeat, or other
                processes are out of reach.
        """
        if world_size is not None:
            distributed.refuse_unreachable_ranks(world_size)
        settings = dict(defaults or {})
        if self.config.start_iter is None:
            settings["start_iter"] = start_iter if start_iter is not None or self.config.enabled else 0
        self.config = config = dataclasses.replace(self.config, **settings)
        if config.start_iter is None:
            raise SkipGSError("This trainer does not densify, so the gate cannot know when to begin; give start_iter=.")
        self.start = config.start_iter
        if config.enabled and gradients_read_until is not None and self.start < gradients_read_until:
            raise SkipGSError(
                f"start_iter={self.start} is too early: up to iteration {gradients_read_until} this trainer's "
                "densification reads the gradients; start there or later, or leave start_iter out."
            )
        if view_names is not None:
            self._view_names = require_unique(view_names)
        if config.enabled and max_steps is not None and self.start > max_steps:
            log.warning("The gate starts at %d, after the last iteration %d.", self.start, max_steps)
        if self.policy is None:
            self.policy = SkipPolicy(
                start_iter=config.start_iter,
                threshold=config.threshold,
                ema_decay=config.ema_decay,
                warmup=config.warmup,
                min_bwd_ratio=config.min_bwd_ratio,
                enabled=config.enabled,
                pause_iters=config.pause_iters,
            )
        if self._pending_state is not None:
            self.load_state_dict(self._pending_state)

    @property
    def active(self) -> bool:
        """Whether the present iteration is gated."""
        return self.config.enabled and self.step is not None and self.step >= self.start

    @property
    def skipped(self) -> bool:
        """Whether the present iteration has a backward that was skipped, and none that ran."""
        return self._decision.skip and not self.ran

    @property
    def step_at_once(self) -> bool:
        """Whether this iteration's gradients are stepped without accumulating."""
        return self._decision.reason in STEP_AT_ONCE

    @property
    def n_views(self) -> int:
        """Number of training views, or of those seen so far where the trainer does not tell."""
        return self.stats.n_views if self._view_names is None else len(self._view_names)

    def mean(self, view: str) -> float | None:
        """Running mean of a view's loss, None for a view without one or a policy without means."""
        return self.policy.means.get(view) if isinstance(self.policy, SkipPolicy) else None

    def open_iteration(self, step: int) -> None:
        """Iteration `step` begins.

        Raises:
            GateOrderError: It lies before the previous one.
        """
        if self.step is None and not self._asked_for_state:
            self._asked_for_state = True
            saved_state = getattr(self.adapter, "saved_state", None)
            state = None if saved_state is None else saved_state(step)
            if state is not None:
                self.load_state_dict(state)
        if self.step is not None and step < self.step:
            raise GateOrderError(
                f"Iterations went back from {self.step} to {step}: load the gate state that belongs to "
                "the checkpoint, or attach a new gate."
            )
        self.step = step
        self._forget_iteration()
        self.clock.open(post=step >= self.start)

    def gate(self, view: str, signal: float | Tensor, run: Callable[[], Any]) -> bool:
        """Call `run`, a real backward, unless the view can do without; True when it was called."""
        skip = self.decide(view, signal).skip
        if not skip:
            run()
            self.ran = True
        self.clock.mark()
        return not skip

    def decide(self, view: str, signal: float | Tensor) -> Decision:
        """Decide on one view in the present iteration, with all processes, and record the answer.

        The signal is read on the host only from `start` on.
        """
        assert self.step is not None
        self.stats.iterations += 1
        if not self.active:
            self._decision = decision.INACTIVE
            return self._decision
        loss = float(signal.detach() if isinstance(signal, Tensor) else signal)
        mean = None if self.trace is None else self.mean(view)
        answer = self._decision = self._agreed(view, loss, self.step)
        self.stats.record(answer, view, loss)
        if self.trace is not None:
            self.trace.append(TraceRow(self.step, view, loss, mean, answer.reason, answer.skip))
        return answer

    def notify_event(self, kind: str, step: int) -> None:
        """A structural change happened in iteration `step`; those of densification are ignored."""
        assert self.policy is not None
        if not self.config.enabled or step < self.start - 1:
            return
        self.stats.events[kind] = self.stats.events.get(kind, 0) + 1
        self._scene_check.stop()
        self.policy.notify_event(step, self.n_views)
        self.steps.accumulator.reset(stepped=False)

    def state_dict(self) -> dict[str, Any]:
        """As `SkipGate.state_dict`."""
        if self.policy is None or self._pending_state is not None:
            return dict(self._pending_state or {})
        self.clock.mark()
        return {
            "version": GATE_VERSION,
            "policy": self.policy.state_dict(),
            "stats": self.stats.state_dict(),
            "accumulator": self.steps.accumulator.state_dict(),
            "non_finite_in_a_row": self._guard.in_a_row,
            "clock": self.clock.state_dict(),
            "step": self.step,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """As `SkipGate.load_state_dict`; before `configure` the state is kept until then."""
        require_state(state)
        if self.policy is None:
            self._pending_state = dict(state)
            return
        self._pending_state = None
        accumulator = self.steps.accumulator
        state = gate_state(state)
        if is_release_state(state):
            self._refuse_other_scene(state["view_loss_ema"])
            self.policy.load_state_dict(state)
            self.stats.load_release_state(state)
            accumulator.load_release_state(state)
            self.step = None
        else:
            self._refuse_other_scene(state["stats"]["views"])
            self.policy.load_state_dict(state["policy"])
            self.stats.load_state_dict(state["stats"])
            accumulator.load_state_dict(state["accumulator"])
            self._guard.in_a_row = state["non_finite_in_a_row"]
            self.clock.load_state_dict(state["clock"])
            self.step = state["step"]
        self._scene_check.start()
        self._forget_iteration()

    def _forget_iteration(self) -> None:
        self._decision = decision.INACTIVE
        self.ran = False
        self.steps.begin_iteration()

    def _agreed(self, view: str, loss: float, step: int) -> Decision:
        if distributed.group_size() == 1:
            if not self._ranks_checked:
                distributed.refuse_unreachable_ranks()
                self._ranks_checked = True
            return self._own(view, loss, step)
        try:
            own = self._own(view, loss, step)
        except SkipGSError:
            distributed.abort()
            raise
        answer = distributed.agree(own)
        # A policy that counts its skips is told of one that did not happen.
        overrule = getattr(self.policy, "overrule_skip", None)
        if answer is decision.OTHER_RANK and overrule is not None:
            overrule()
        return answer

    def _own(self, view: str, loss: float, step: int) -> Decision:
        assert self.policy is not None
        if loss - loss != 0.0:  # NaN or infinite
            return self._guard.answer(view, loss, step, self.mean(view), self.n_views)
        self._guard.in_a_row = 0
        if self.adapter is not None and self.adapter.must_run(step):
            return decision.FORCED
        if self._scene_check.running:
            self._scene_check.see(loss, self.mean(view), step)
        return self.policy.decide(view, loss, step)

    def _refuse_other_scene(self, views: Iterable[Any]) -> None:
        if self._view_names is None:
            return
        unknown = sorted({str(view) for view in views} - set(self._view_names))
        if unknown:
            raise SkipGSError(
                f"The gate state belongs to another scene: it knows view {unknown[0]!r}, which is not among "
                f"the {len(self._view_names)} training views; start the gate afresh."
            )
