"""FastGS: gradients accumulate over 16, 32 or 64 iterations, so only the backward may be gated."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily

ACCUMULATES_FROM = 15_000  # `optimizer_step` has these numbers in it
SLOWER_FROM = 20_000


class FastGS(InriaFamily):
    """`optimizer_step(iteration)` stays untouched: it applies what the backwards since its last step left.

    It is called in skipped iterations too, where it may have the gradients of earlier ones to apply. After
    densification Gaussians are pruned at iterations 18,000, 21,000, 24,000 and 27,000.
    """

    name = "fastgs"
    checked = "fastgs/FastGS 44e02a5c (its script, run on the CPU)"
    project = "[FastGS](https://github.com/fastgs/FastGS)"
    gated = "From `densify_until_iter` on. The prunes at 18,000, 21,000, 24,000 and 27,000 pause the gate."
    left_alone = (
        "`optimizer_step(iteration)`: it steps every 16th, 32nd or 64th iteration on what the backwards since then "
        "have left, and does so in an iteration that is skipped itself."
    )
    stand_ins = "fastgs"
    mark = "render_fastgs"
    calls = ("densify_and_prune_fastgs", "final_prune_fastgs", "optimizer_step")
    arguments = ("get_flag", "metric_map")
    renders = ("render_fastgs",)

    def accumulates(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        default = getattr(opt, "optimizer_type", "default") == "default"
        return default and self.start_iter(opt, loop) >= ACCUMULATES_FROM

    def always_run(self, numbers: range) -> Iterable[int]:
        """Those in which `optimizer_step` steps an optimizer on what gathered over several."""
        return (n for n in numbers if n % interval(n) == 0)


def interval(iteration: int) -> int:
    """Iterations between two of the rarer steps."""
    if iteration <= ACCUMULATES_FROM:
        return 16
    return 32 if iteration <= SLOWER_FROM else 64
