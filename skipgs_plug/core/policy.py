"""The rule of the paper (SkipGS, arXiv 2603.08997), in one place. Standard library only."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable
from typing import Any

from skipgs_plug.core import decision
from skipgs_plug.core.budget import BackwardBudget
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.ema import ViewMeans
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pause import Pause
from skipgs_plug.core.state import POLICY_VERSION, policy_state

# Added to a mean (unit of the loss) before the loss is divided by it, so that a mean of 0 is no division by zero. The
# value is that of the authors' controller.
EPS = 1e-8

# Decisions that the floor counts. A pause counts neither for nor against it.
_COUNTED = (
    decision.WARM_UP,
    decision.NEW_VIEW,
    decision.ABOVE_MEAN,
    decision.AT_OR_BELOW_MEAN,
    decision.BUDGET,
)


class Policy(ABC):
    """Base class of policies: the rule of the paper, or a control for a benchmark.

    Derive from it and write the four abstract methods. The defaults of the other members suit a policy without a start,
    means or a floor.
    """

    __slots__ = ()

    @property
    def start_iter(self) -> int:
        """First iteration that may be skipped, for a gate without a trainer and without that setting."""
        return 0

    @property
    def floor(self) -> float | None:
        """Least share of backward passes that must run; None without a floor."""
        return None

    def mean(self, view: Hashable) -> float | None:
        """Return the running mean of a view's loss; None if the view or the policy has no mean.

        Args:
            view: Key of the view.
        """
        return None

    def known_ahead(self, view: Hashable, step: int) -> bool | None:
        """Return whether `decide` will skip, if that is known without the loss; None if it is unknown.

        The call changes nothing. It returns True only in iterations that train nothing; `decide` is then not called
        with their loss.

        Args:
            view: Key of the view.
            step: Number of the iteration.
        """
        return None

    @abstractmethod
    def decide(self, view: Hashable, loss: float, step: int) -> Decision:
        """Decide on one view in one iteration, and record the answer.

        Args:
            view: Key of the view.
            loss: Loss of the view, or another value that the user decides by; finite.
            step: Number of the iteration.
        """

    def overrule(self, own: Decision, answer: Decision) -> None:
        """Replace the decision that was recorded last.

        Args:
            own: That decision.
            answer: The decision on which the processes agreed.
        """
        return None

    @abstractmethod
    def notify_event(self, step: int, n_views: int) -> None:
        """Take note of a structural change.

        Args:
            step: Iteration of the change.
            n_views: Number of training views.
        """

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return plain values from which `load_state_dict` continues exactly."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a saved state.

        Args:
            state: Result of `state_dict()`.
        """


class SkipPolicy(Policy):
    """The rule of the paper: skip a view's backward pass while its loss is at or below its own running mean.

    From `start_iter` on, the deviation score of a view is loss / (mean + 1e-8). Its backward pass is skipped when the
    score is at most 1 + threshold, unless the floor on the share of backward passes forbids it. The arguments are
    those of `SkipConfig`. Without structural changes and with finite losses, the decisions are those of the authors'
    released controller, one for one, with one exception: warm-up counts from the first iteration that the policy sees,
    so that a run that is resumed late still sets its floor.

    Examples:
        >>> from skipgs_plug.core.policy import SkipPolicy
        >>> policy = SkipPolicy(start_iter=100, warmup=0)
        >>> policy.decide("a.png", loss=0.5, step=99)
        Decision(skip=False, reason='inactive')
        >>> policy.decide("a.png", loss=0.5, step=100)
        Decision(skip=False, reason='new view')
        >>> policy.decide("a.png", loss=0.4, step=101)
        Decision(skip=True, reason='deviation')
    """

    __slots__ = (
        "_ceiling",
        "_start_iter",
        "_warmup",
        "_warmup_end",
        "budget",
        "enabled",
        "means",
        "pause",
    )

    def __init__(
        self,
        start_iter: int | None,
        threshold: float = SkipConfig.threshold,
        ema_decay: float = SkipConfig.ema_decay,
        warmup: int = SkipConfig.warmup,
        min_bwd_ratio: float | str = SkipConfig.min_bwd_ratio,
        enabled: bool = SkipConfig.enabled,
        pause_iters: int | None = SkipConfig.pause_iters,
    ) -> None:
        if start_iter is None:
            raise SkipGSError("SkipPolicy needs start_iter, the iteration at which densification has ended.")
        SkipConfig(start_iter, threshold, ema_decay, warmup, min_bwd_ratio, enabled, pause_iters=pause_iters)
        self._start_iter = start_iter
        self.enabled = enabled
        self.means = ViewMeans(ema_decay)
        self.budget = BackwardBudget(min_bwd_ratio)
        self.pause = Pause(pause_iters)
        self._ceiling = 1.0 + threshold
        self._warmup = warmup
        self._warmup_end: int | None = None

    @classmethod
    def from_config(cls, config: SkipConfig) -> SkipPolicy:
        """Return the policy with these settings.

        Args:
            config: Settings, of which `start_iter` is given.

        Raises:
            SkipGSError: `start_iter` is None.
        """
        names = ("threshold", "ema_decay", "warmup", "min_bwd_ratio", "enabled", "pause_iters")
        return cls(config.start_iter, **{name: getattr(config, name) for name in names})

    @property
    def start_iter(self) -> int:
        """First iteration that may be skipped."""
        return self._start_iter

    @property
    def floor(self) -> float:
        """Least share of backward passes that must run."""
        return self.budget.floor

    def mean(self, view: Hashable) -> float | None:
        """Return the running mean of a view's loss; None for a new view.

        Args:
            view: Key of the view.
        """
        return self.means.get(view)

    def decide(self, view: Hashable, loss: float, step: int) -> Decision:
        """Decide whether to skip the backward pass of a view.

        Call it once per view and iteration, after the forward pass. The answer is recorded as if it is followed.

        Args:
            view: Key of the view.
            loss: Loss of the view. A loss that is not finite enters no mean.
            step: Number of the iteration, counted like `start_iter`.
        """
        if step < self._start_iter or not self.enabled:
            return decision.INACTIVE
        if loss - loss != 0.0:  # NaN or infinite
            return decision.NON_FINITE
        if step < self.pause.until:
            return decision.PAUSE
        if self._warmup_end is None:
            self._warmup_end = step + self._warmup
        mean = self.means.update(view, loss)
        at_or_below = mean is not None and loss / (mean + EPS) <= self._ceiling
        budget = self.budget
        if step < self._warmup_end:
            if mean is not None and budget.calibrating:
                budget.observe_warmup(at_or_below)
            budget.backwards += 1
            return decision.WARM_UP
        if mean is None:
            answer = decision.NEW_VIEW
        elif not at_or_below:
            answer = decision.ABOVE_MEAN
        else:
            answer = decision.AT_OR_BELOW_MEAN if budget.allows_skip() else decision.BUDGET
        if answer.skip:
            budget.skips += 1
        else:
            budget.backwards += 1
        # The first decision after warm-up is still taken under the uncalibrated floor, as in the release.
        if budget.calibrating:
            budget.calibrate()
        return answer

    def known_ahead(self, view: Hashable, step: int) -> bool | None:
        """Return False in a pause, in warm-up, for a new view, and while the floor forbids skipping; else None.

        Args:
            view: Key of the view.
            step: Number of the iteration, counted like `start_iter`.
        """
        if step < self._start_iter or not self.enabled or step < self.pause.until:
            return False
        warmup_end = step + self._warmup if self._warmup_end is None else self._warmup_end
        if step < warmup_end or not self.budget.allows_skip():
            return False
        return False if self.means.get(view) is None else None

    def overrule(self, own: Decision, answer: Decision) -> None:
        """Count the decision that takes effect in place of the one that was recorded last.

        Another process needed the backward pass, or its loss was not finite. In the latter case the iteration does not
        count, like an iteration whose own loss is not finite.

        Args:
            own: The decision that was recorded.
            answer: The decision on which the processes agreed.
        """
        if own not in _COUNTED:
            return
        if own.skip:
            self.budget.skips -= 1
        else:
            self.budget.backwards -= 1
        if answer is decision.OTHER_RANK:
            self.budget.backwards += 1

    def notify_event(self, step: int, n_views: int) -> None:
        """Pause after a structural change.

        Changes before the iteration that precedes `start_iter` belong to densification and are ignored. A
        pause inside warm-up postpones the rest of warm-up.

        Args:
            step: Iteration of the change.
            n_views: Number of training views; a pause has at least one iteration for each.
        """
        if not self.enabled or step < self._start_iter - 1:
            return
        added = self.pause.extend(step, n_views)
        if self._warmup_end is not None and step < self._warmup_end:
            self._warmup_end += added

    def state_dict(self) -> dict[str, Any]:
        """Return everything that changes, as plain values with string keys.

        Returns:
            `version` (2); `means` (mean by view key); `budget` (`floor`, `backwards`, `skips`,
            `calibrating`, `would_skip`, `would_total`); `warmup_end` (iteration, None before the first
            gated one); `pause_until` (iteration); `events` (count).
        """
        return {
            "version": POLICY_VERSION,
            "means": self.means.state_dict(),
            "budget": self.budget.state_dict(),
            "warmup_end": self._warmup_end,
            "pause_until": self.pause.until,
            "events": self.pause.changes,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict()`, or from a state of the authors' controller (`state_version` 1).

        Args:
            state: The state.

        Raises:
            SkipGSError: The state is of another version, or something is missing from it.
        """
        state = policy_state(state, self._start_iter + self._warmup)
        self.means.load_state_dict(state["means"])
        self.budget.load_state_dict(state["budget"])
        self._warmup_end = state["warmup_end"]
        self.pause.until = state["pause_until"]
        self.pause.changes = state["events"]
