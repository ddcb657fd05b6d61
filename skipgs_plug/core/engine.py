"""One gated iteration, driven by the verbs of a user's loop or by the hooks of an adapter."""

from __future__ import annotations

import dataclasses
import logging
import math
import weakref
from collections.abc import Callable
from typing import Any

from torch import Tensor

from skipgs_plug.core import decision, distributed
from skipgs_plug.core.clock import GateClock
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.errors import GateOrderError, SkipGSError
from skipgs_plug.core.gated_iteration import GatedIteration
from skipgs_plug.core.loss_scaler import unscaled
from skipgs_plug.core.nonfinite import NonFiniteGuard
from skipgs_plug.core.pace.choose import pace_of
from skipgs_plug.core.pace.phased import other_shares
from skipgs_plug.core.pace.rates import ScaledRates
from skipgs_plug.core.policy import Policy
from skipgs_plug.core.release import Release
from skipgs_plug.core.saved_graph import drop_gradients, free_graph
from skipgs_plug.core.scene_check import SceneCheck, require_same_scene
from skipgs_plug.core.state import GATE_VERSION, gate_state, is_release_state, require_state
from skipgs_plug.core.stats import GateStats
from skipgs_plug.core.trace import TraceRow
from skipgs_plug.core.trainer_info import TrainerInfo
from skipgs_plug.core.views import require_unique, warn_unless_recurring
from skipgs_plug.host_copy import HostCopy, copies_in_background, on_host

log = logging.getLogger(__name__)


class Engine:
    """Decides, runs or skips, counts; holds all state of a gate.

    Args:
        config: Settings that the user gave.
        policy: Decides in place of `SkipPolicy`.
        record_trace: Keep every gated decision.
        must_run: Whether skipping is forbidden in an iteration, whose loss is not to be recorded either.
        saved_state: Returns the state of the checkpoint from which training continues, if any; called
            once, with the first iteration.

    Attributes:
        config: Settings in force.
        policy: The policy; None until `configure` is called.
        start: First iteration that may be skipped.
        iteration: Facts about the present iteration.
        stats, clock: Counts, seconds.
        release: Releases the gate after an error.
        rates: Scales learning rates, for the pace.
        pace: Decides which iterations run, and scales learning rates.
        trace: Rows of gated decisions; None if they are not recorded.
    """

    def __init__(
        self,
        config: SkipConfig,
        policy: Policy | None = None,
        record_trace: bool = False,
        must_run: Callable[[int], bool] | None = None,
        saved_state: Callable[[int], dict[str, Any] | None] | None = None,
    ) -> None:
        self.config = config
        self.policy = policy
        self.start = 0
        self.iteration = GatedIteration()
        self.stats = GateStats()
        self.clock = GateClock()
        iteration = self.iteration
        # A refusal in the first iteration loses nothing.
        self.release = Release(config.enabled, lambda: iteration.opened <= 1)
        own = weakref.ref(self)  # PyTorch holds the hooks of the rates, which must not keep a dropped gate alive

        def taken_back() -> None:
            if (engine := own()) is not None:
                engine.remove()

        self.release.undoes(taken_back)
        self.rates = ScaledRates()
        release = self.release
        self.rates.on_error = lambda error: release.on_error(error, iteration.step)
        self.pace = pace_of(config, self.rates, self._go_on_from_saved, release)
        self.trace: list[TraceRow] | None = [] if record_trace else None
        self._skipped: list[weakref.ref[Tensor]] = []  # losses of this iteration whose backwards were skipped
        self._accumulates = False
        self._guard = NonFiniteGuard(config.on_nonfinite)
        self._must_run = must_run
        self._saved_state = saved_state
        self._view_names: list[str] | None = None
        self._pending_state: dict[str, Any] | None = None
        self._scene_check = SceneCheck()

    def configure(self, info: TrainerInfo, given: frozenset[str] = frozenset()) -> None:
        """Complete the settings with the facts about the trainer, and create the policy.

        Args:
            info: Facts about the trainer.
            given: Names of settings that the user gave, which no default replaces.

        Raises:
            SkipGSError: `start_iter` is unknown or too early, view names repeat, or other processes cannot be reached.
        """
        if info.world_size is not None:
            distributed.refuse_unreachable_ranks(info.world_size)
        settings = {name: value for name, value in info.defaults.items() if name not in given}
        if self.config.start_iter is None:
            settings["start_iter"] = 0 if info.start_iter is None and not self.config.enabled else info.start_iter
            if self.pace.leaves_out and info.settled_iter is not None:
                settings["start_iter"] = max(info.start_iter or 0, info.settled_iter)
        self.config = config = dataclasses.replace(self.config, **settings)
        if config.start_iter is None:
            sentence = "It is not known when this trainer's densification ends, or that it densifies at all; give"
            raise SkipGSError(f"{sentence} start_iter=.", in_script=f"{sentence} --start-iter.")
        self.start = config.start_iter
        read_until = info.gradients_read_until
        if config.enabled and read_until is not None and self.start < read_until:
            raise SkipGSError(
                f"start_iter={self.start} is too early: up to iteration {read_until} this trainer's "
                "densification reads the gradients; start there or later, or leave start_iter out."
            )
        last = max(config.always or (0,))
        if config.enabled and info.max_steps is not None and last > info.max_steps:
            sentence = f"iteration {last}, and the run ends with {info.max_steps}; leave it out"
            raise SkipGSError(f"always names {sentence}.", in_script=f"--always names {sentence}.")
        if info.view_names is not None:
            self._view_names = require_unique(info.view_names)
        if config.enabled and info.max_steps is not None and self.start > info.max_steps:
            why = "The gate starts at %d, after the last iteration %d. Nothing is refined; end densification sooner."
            log.warning(why, self.start, info.max_steps)
        self._accumulates = info.accumulates
        self.pace.configure(self.start, info, self._view_names)
        if self.policy is None:
            self.policy = self.pace.policy(config)
        if self._pending_state is not None:
            self.load_state_dict(self._pending_state)

    def remove(self) -> None:
        """Let go of loops and optimizers; counts stay readable."""
        self.pace.remove()
        self.rates.remove()

    @property
    def active(self) -> bool:
        """Whether the present iteration is gated."""
        return self.iteration.gated

    @property
    def skipped(self) -> bool:
        """Whether a backward pass of the present iteration was skipped and no other one ran."""
        return self.iteration.skipped

    @property
    def n_views(self) -> int:
        """Number of training views; if the trainer does not tell it, of the views seen so far."""
        return self.stats.n_views if self._view_names is None else len(self._view_names)

    def mean(self, view: str) -> float | None:
        """Return the running mean of a view's loss; None if the view or the policy has no mean."""
        return None if self.policy is None else self.policy.mean(view)

    def open_iteration(self, step: int) -> None:
        """Begin iteration `step`.

        Raises:
            GateOrderError: The number is smaller than that of the previous iteration.
            SkipGSError: This is the first iteration, and a process that trains together with this one has no gate.
        """
        if not self.iteration.opened and self.config.enabled:
            distributed.require_gates()
        if self.iteration.step is None:
            self._go_on_from_saved(step)
        if self.iteration.step is not None and step < self.iteration.step:
            raise GateOrderError(
                f"Iterations went back from {self.iteration.step} to {step}: load the gate state that belongs to "
                "the checkpoint, or attach a new gate."
            )
        self.pace.begin(step, self.policy)
        post = step >= self.start
        self.iteration.opened += 1
        self.iteration.begin(step, gated=post and self.config.enabled)
        self._skipped.clear()
        self.clock.open(post)

    def gate(
        self, view: str, signal: float | Tensor, run: Callable[[], Any], loss: Tensor, frees_graph: bool = False
    ) -> bool:
        """Call `run`, a real backward pass, unless it is skipped; return True if gradients were computed and kept.

        Many decisions do not depend on the loss. On a device, the backward pass is then launched while the loss is
        copied to the host. If the loss turns out not to be finite, its gradients are dropped before an optimizer steps.

        Args:
            view: Key of the view.
            signal: Value to decide by. A loss that a scaler has scaled stands for the loss before.
            run: The backward pass.
            loss: The tensor whose backward pass runs.
            frees_graph: Whether nothing needs the graph after the backward pass, so that a skip can free it at once.
        """
        now = self.iteration
        if not now.gated:
            self.stats.iterations += 1
            now.run(run)
            self.clock.mark()
            return True
        signal = unscaled(signal)
        ahead = self._known_ahead(view, signal)
        if ahead is False:
            skip = self._run_first(view, signal, run, loss)
        else:
            # The loss is not read in iterations that train nothing.
            skip = self.decide(view, None if ahead else signal).skip
            if not skip:
                now.run(run)
                self.rates.ran()
            else:
                self._skipped.append(weakref.ref(loss))
                if frees_graph:
                    self.free_skipped()
        self.clock.mark()
        return not skip

    def free_skipped(self) -> None:
        """Free the tensors saved for the skipped backward passes of this iteration, which has no further ones."""
        for reference in self._skipped:
            loss = reference()
            if loss is not None:
                free_graph(loss)
        self._skipped.clear()

    def _known_ahead(self, view: str, signal: float | Tensor) -> bool | None:
        """Whether the backward of a gated iteration is skipped, if that is known without waiting for the loss."""
        now = self.iteration
        if not (isinstance(signal, Tensor) and copies_in_background(signal.device)):
            return None
        # Other processes must be asked. With accumulation, a non-finite loss would drop earlier gradients too.
        if self._accumulates or self._scene_check.running or distributed.group_size() > 1:
            return None
        assert self.policy is not None and now.step is not None
        if self._must_run is not None and self._must_run(now.step):
            return False
        return self.policy.known_ahead(view, now.step)

    def _run_first(self, view: str, signal: float | Tensor, run: Callable[[], Any], loss: Tensor) -> bool:
        """Launch the backward pass, then decide; return True if its gradients were dropped."""
        assert isinstance(signal, Tensor)
        copy = HostCopy(signal)
        self.iteration.run(run)
        try:
            skip = self.decide(view, copy).skip
        except SkipGSError as error:
            if self.release.ends(error):
                drop_gradients(loss)
            raise
        if skip:
            drop_gradients(loss)
            self.iteration.ran = False
        else:
            self.rates.ran()
        return skip

    def decide(self, view: str, signal: float | Tensor | HostCopy | None) -> Decision:
        """Decide on one view in the present iteration, with all processes, and record the answer.

        Args:
            view: Key of the view.
            signal: Value to decide by, read on the host only from `start` on; None in iterations that train nothing.
        """
        now = self.iteration
        assert now.step is not None
        self.stats.iterations += 1
        if not now.gated or self.release.reason is not None:
            now.decision = decision.INACTIVE
            return now.decision
        mean = None if self.trace is None else self.mean(view)
        if signal is None:
            loss, answer = math.nan, decision.OVER
        else:
            loss = on_host(signal)
            answer = self._agreed(view, loss, now.step, signal)
        now.decision = answer
        if self.stats.record(answer, view, None if signal is None else loss) and self._view_names is None:
            warn_unless_recurring(self.stats.n_views, self.stats.gated)
        if self.trace is not None:
            self.trace.append(TraceRow(now.step, view, loss, mean, answer.reason, answer.skip))
        return answer

    def notify_event(self, kind: str, step: int) -> None:
        """Take note of a structural change; changes of densification are ignored.

        Args:
            kind: Name of the change for the report.
            step: Iteration of the change.
        """
        assert self.policy is not None
        if not self.config.enabled or step < self.start - 1:
            return
        self.stats.changes[kind] = self.stats.changes.get(kind, 0) + 1
        self._scene_check.stop()
        self.policy.notify_event(step, self.n_views)

    def state_dict(self) -> dict[str, Any]:
        """Return the state; see `SkipGate.state_dict`."""
        if self.policy is None or self._pending_state is not None:
            return dict(self._pending_state or {})
        self.clock.mark(exactly=True)
        return {
            "version": GATE_VERSION,
            "policy": self.policy.state_dict(),
            "stats": self.stats.state_dict(),
            "non_finite_in_a_row": self._guard.in_a_row,
            "clock": self.clock.state_dict(),
            "step": self.iteration.step,
            "pace": self.pace.state_dict(),
            "visibility": self.rates.visibility.state_dict(),
            "size_bound": self.rates.sizes.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a state; see `SkipGate.load_state_dict`. Before `configure`, the state is kept until that call."""
        require_state(state)
        if not self.config.enabled and state.get("pace") is not None:
            return  # a gate that is off leaves out no iterations
        if self.policy is None:
            self._pending_state = dict(state)
            # The loop asks about its first number before the trainer reports anything else.
            self._load_pace(gate_state(state))
            return
        pending, self._pending_state = self._pending_state is not None, None
        state = gate_state(state)
        if is_release_state(state):
            self._load_pace(state)
            require_same_scene(state["view_loss_ema"], self._view_names)
            self.policy.load_state_dict(state)
            self.stats.load_release_state(state)
            step = None
        else:
            require_same_scene(state["stats"]["views"], self._view_names)
            if not pending:
                self._load_pace(state)
            self.policy.load_state_dict(state["policy"])
            self.stats.load_state_dict(state["stats"])
            self._guard.in_a_row = state["non_finite_in_a_row"]
            self.clock.load_state_dict(state["clock"])
            step = state["step"]
        # A pace that leaves out iterations does not pause, so means are far off for a long time after a change.
        if not self.pace.leaves_out or not self.stats.changes:
            self._scene_check.start()
        self.iteration.begin(step, gated=step is not None and step >= self.start and self.config.enabled)

    def _go_on_from_saved(self, step: int) -> None:
        """Load the state of the checkpoint from which training continues with iteration `step`, if there is one."""
        ask, self._saved_state = self._saved_state, None
        state = None if ask is None else ask(step)
        if state is not None:
            self.load_state_dict(state)

    def _load_pace(self, whole: dict[str, Any]) -> None:
        """Load the states of the pace and of its steps; the authors' controller has none."""
        state = whole.get("pace")
        if (state is None) == self.pace.leaves_out:
            raise other_shares(state, self.config)
        if state is not None:
            self.pace.load_state_dict(state)  # first, since it can refuse the state
        if "visibility" in whole:
            self.rates.visibility.load_state_dict(whole["visibility"])
            self.rates.sizes.load_state_dict(whole["size_bound"])

    def _agreed(self, view: str, loss: float, step: int, signal: float | Tensor | HostCopy) -> Decision:
        if distributed.group_size() == 1:
            return self._own(view, loss, step)
        device = signal.device if isinstance(signal, Tensor) else None
        own, answer = self.release.agreed(lambda: self._own(view, loss, step), step, device)
        if answer is not own:
            assert self.policy is not None
            self.policy.overrule(own, answer)
        return answer

    def _own(self, view: str, loss: float, step: int) -> Decision:
        assert self.policy is not None
        if loss - loss != 0.0:  # NaN or infinite
            return self._guard.answer(view, loss, step, self.mean(view), self.n_views)
        self._guard.in_a_row = 0
        if self._must_run is not None and self._must_run(step):
            return decision.FORCED
        if not self._scene_check.running:
            return self.policy.decide(view, loss, step)
        mean = self.mean(view)
        answer = self.policy.decide(view, loss, step)
        if answer is decision.PAUSE:
            self._scene_check.stop()  # means are from before the change
        self._scene_check.see(loss, mean, step)
        return answer
