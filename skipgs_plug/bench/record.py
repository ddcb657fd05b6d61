"""The results of one run (one seed under one policy), as plain values."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

# One letter per iteration; upper case means that the backward was skipped.
REASON_CODES = {
    "own": "-",
    "warm-up": "w",
    "new view": "n",
    "deviation": "d",
    "budget": "b",
    "pause": "p",
    "forced": "f",
    "planned": "c",
    "inactive": "i",
    "non-finite": "x",
    "other rank": "o",
    "full": "a",
    "watched": "v",
    "over": "e",
}
OTHER_REASON = "u"  # a reason outside the table
LEFT_OUT = "."  # the whole iteration was left out, forward pass included
DIGITS = 5  # significant digits of losses and means in a trace: more only make the files larger


@dataclass
class Trace:
    """Every decision of one refinement, or whole run, one entry per iteration number.

    Attributes:
        start: Iteration of the first entry.
        view: Index into the list of training views; None for a left-out iteration.
        loss: Loss that the decision read; None for a left-out iteration.
        mean: The view's running mean before this loss; None for a view without a mean.
        codes: One letter per iteration, from REASON_CODES, or LEFT_OUT.
    """

    start: int
    view: list[int | None] = field(default_factory=list)
    loss: list[float | None] = field(default_factory=list)
    mean: list[float | None] = field(default_factory=list)
    codes: str = ""

    def add(self, view: int, loss: float, mean: float | None, reason: str, skip: bool) -> None:
        """Append an iteration that ran its forward pass."""
        code = REASON_CODES.get(reason, OTHER_REASON)
        self._append(view, rounded(loss), None if mean is None else rounded(mean), code.upper() if skip else code)

    def fill(self, end: int) -> None:
        """Append the missing iterations before `end`, which were left out."""
        for _ in range(self.end, end):
            self._append(None, None, None, LEFT_OUT)

    @property
    def end(self) -> int:
        """Iteration after the last entry."""
        return self.start + len(self.codes)

    @property
    def ran(self) -> list[bool]:
        """Whether each iteration ran, at least its forward pass."""
        return [code != LEFT_OUT for code in self.codes]

    @property
    def skipped(self) -> list[bool]:
        """Whether each iteration ran its forward pass and skipped its backward pass."""
        return [code.isupper() for code in self.codes]

    def _append(self, view: int | None, loss: float | None, mean: float | None, code: str) -> None:
        self.view.append(view)
        self.loss.append(loss)
        self.mean.append(mean)
        self.codes += code


@dataclass
class Point:
    """One evaluation on held-out views, outside the clock."""

    step: int
    seconds: float  # time of refinement, or of the whole run, so far
    metrics: dict[str, float]  # by the names of trainer.metrics.METRICS

    def as_dict(self) -> dict[str, Any]:
        return {"step": self.step, "seconds": self.seconds, **self.metrics}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Point:
        metrics = dict(content)
        return cls(metrics.pop("step"), metrics.pop("seconds"), metrics)


@dataclass
class RunRecord:
    """One seed under one policy.

    Attributes:
        status: "done", "diverged" (a loss was not finite), or "not run" (the policy that it copies diverged).
        note: One sentence about a run that is not done.
        iterations: Iterations of refinement by number, including those that were left out.
        iterations_run: Iterations that ran, even if only their forward pass did.
        backwards: Backward passes of refinement.
        warm_up: Warm-up iterations, in which the gate does not skip; 0 without a gate.
        floor: Smallest share of backward passes in force at the end; None without a gate.
        gaussians_shown: Share of the Gaussians that a view shows; None if steps are not larger.
        reasons: Number of gated decisions by reason; empty without a gate.
        t_post, t_total: Seconds of refinement and of the whole training, by the clock of the bench.
        seconds: Both times by both clocks, see `TrainClock.seconds`.
        phases: Seconds of refinement, or of the whole run, in forward, loss, backward, optimizer, strategy.
        metrics: Metrics on held-out views, by the names of trainer.metrics.METRICS, and num_GS.
        train_metrics: The same on the training views, without LPIPS.
        exact_views: Number of held-out views that the final model renders exactly, with infinite PSNR.
        points: Evaluations on held-out views: before, on the way, at the end.
        peak_memory: Largest number of bytes in use, on the GPU or by the process, without other runs that take turns;
            None if the system does not report it.
        chosen: Shares and rate factor that a whole run chose: `grow_share`, `grow_rate_factor`, `refine_share`; empty
            if it leaves out no iterations.
        tries: Settings that a search tried, with their results; empty without a search.
        commit: Commit of this package during the run.
    """

    seed: int
    policy: str
    status: Literal["done", "diverged", "not run"] = "done"
    note: str = ""
    iterations: int = 0
    iterations_run: int = 0
    backwards: int = 0
    warm_up: int = 0
    floor: float | None = None
    gaussians_shown: float | None = None
    reasons: dict[str, int] = field(default_factory=dict)
    t_post: float = 0.0
    t_total: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    phases: dict[str, float] = field(default_factory=dict)
    metrics: dict[str, float] = field(default_factory=dict)
    train_metrics: dict[str, float] = field(default_factory=dict)
    exact_views: int = 0
    points: list[Point] = field(default_factory=list)
    trace: Trace | None = None
    peak_memory: int | None = None
    chosen: dict[str, float | None] = field(default_factory=dict)
    tries: list[dict[str, float]] = field(default_factory=list)
    commit: str | None = None

    @property
    def skips(self) -> int:
        """Number of backward passes skipped in iterations that ran."""
        return self.iterations_run - self.backwards

    def as_dict(self, with_trace: bool = True) -> dict[str, Any]:
        content = dataclasses.asdict(self)
        content["points"] = [point.as_dict() for point in self.points]
        if not with_trace:
            del content["trace"]
        return content

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> RunRecord:
        """Undo `as_dict`.

        Raises:
            KeyError, TypeError: A field is missing, or the record is of another version.
        """
        record = cls(**content)
        for name in (known.name for known in dataclasses.fields(cls)):
            content[name]  # KeyError for a run of an older version, which lacks fields that have a default
        record.points = [Point.from_dict(point) for point in content["points"]]
        record.trace = None if content["trace"] is None else Trace(**content["trace"])
        return record


def rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
