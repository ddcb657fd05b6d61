"""What one run (one seed under one policy) leaves behind, as plain values."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

# One letter per iteration; upper case means that the backward was skipped.
REASON_CODES = {
    "ungated": "-",
    "warm-up": "w",
    "new view": "n",
    "deviation": "d",
    "budget": "b",
    "pause": "p",
    "forced": "f",
    "planned": "c",
}
DIGITS = 5  # significant digits of losses and means in a trace


@dataclass
class Trace:
    """Every decision of one refinement, one entry per iteration.

    Attributes:
        start: iteration of the first entry.
        view: index into the list of training views.
        loss: loss that was decided on.
        mean: the view's running mean before this loss; None without one.
        codes: reason letters, see REASON_CODES.
    """

    start: int
    view: list[int] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    mean: list[float | None] = field(default_factory=list)
    codes: str = ""

    def add(self, view: int, loss: float, mean: float | None, reason: str, skip: bool) -> None:
        code = REASON_CODES[reason]
        self.view.append(view)
        self.loss.append(rounded(loss))
        self.mean.append(None if mean is None else rounded(mean))
        self.codes += code.upper() if skip else code

    @property
    def skipped(self) -> list[bool]:
        return [code.isupper() for code in self.codes]


@dataclass
class Point:
    """One evaluation during refinement, outside the clock."""

    step: int
    seconds: float  # of refinement so far
    psnr: float
    ssim: float


@dataclass
class RunRecord:
    """One seed under one policy.

    Attributes:
        status: "done"; "diverged" (its loss stopped being finite); "not run" (what it copies diverged).
        note: one sentence for a run that is not done.
        iterations: of refinement.
        backwards: of refinement.
        warm_up: refinement iterations that the gate kept from skipping; 0 without a gate.
        floor: least share of backwards in force at the end; None without a gate.
        reasons: gated decisions by reason; empty without a gate.
        t_post, t_total: seconds of training, of refinement and in all.
        phases: seconds of refinement in forward, loss, backward, optimizer, strategy.
        metrics: held-out psnr, ssim, and LPIPS by flavour where available; num_GS.
        peak_memory: bytes on the GPU during refinement; None on the CPU.
        commit: of this package, when it ran.
    """

    seed: int
    policy: str
    status: Literal["done", "diverged", "not run"] = "done"
    note: str = ""
    iterations: int = 0
    backwards: int = 0
    warm_up: int = 0
    floor: float | None = None
    reasons: dict[str, int] = field(default_factory=dict)
    t_post: float = 0.0
    t_total: float = 0.0
    phases: dict[str, float] = field(default_factory=dict)
    metrics: dict[str, float] = field(default_factory=dict)
    points: list[Point] = field(default_factory=list)
    trace: Trace | None = None
    peak_memory: int | None = None
    commit: str | None = None

    @property
    def skips(self) -> int:
        return self.iterations - self.backwards

    def as_dict(self, with_trace: bool = True) -> dict[str, Any]:
        content = dataclasses.asdict(self)
        if not with_trace:
            del content["trace"]
        return content

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> RunRecord:
        content = dict(content)
        content["points"] = [Point(**point) for point in content["points"]]
        if content["trace"] is not None:
            content["trace"] = Trace(**content["trace"])
        return cls(**content)


def rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
