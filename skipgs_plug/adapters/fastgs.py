"""FastGS: gradients accumulate over 16, 32 or 64 iterations, so only the backward may be gated."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from skipgs_plug.adapters.inria import GROWS_WHOLE, InriaFamily

# Constants of `optimizer_step`: iterations after which it steps every 32nd, then every 64th iteration.
ACCUMULATES_FROM = 15_000
SLOWER_FROM = 20_000


class FastGS(InriaFamily):
    """`optimizer_step(iteration)` stays untouched: it applies the gradients gathered since its last step.

    It is called in skipped iterations too, and may apply gradients of earlier iterations there. In schedules of 30,000
    iterations densification is nearly all of the training: 15,000 of 15,312 steps of the optimizer. With half of its
    iterations bonsai (100x67, 255 views) loses 0.3 dB and 0.008 SSIM, so all of them run.
    """

    name = "fastgs"
    checked = "fastgs/FastGS 44e02a5c (its script, run on the CPU)"
    project = "[FastGS](https://github.com/fastgs/FastGS)"
    gated = "From `densify_until_iter` on. The prunes at 18,000, 21,000, 24,000 and 27,000 pause the gate."
    left_alone = (
        "`optimizer_step(iteration)` steps every 16th, 32nd or 64th iteration with the gradients gathered since, even "
        "in a skipped iteration."
    )
    with_share = GROWS_WHOLE
    stand_ins = "fastgs"
    mark = "render_fastgs"
    changes = (*InriaFamily.changes, "densify_and_prune_fastgs")
    pausing = ("final_prune_fastgs",)
    calls = ("optimizer_step",)
    arguments = ("get_flag", "metric_map")
    renders = ("render_fastgs",)

    def accumulates(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        default = getattr(opt, "optimizer_type", "default") == "default"
        return default and self.start_iter(opt, loop) >= ACCUMULATES_FROM

    def always_run(self, numbers: range) -> Iterable[int]:
        """Return the iterations in which `optimizer_step` steps with gathered gradients."""
        return (n for n in numbers if n % interval(n) == 0)


def interval(iteration: int) -> int:
    """Return the number of iterations between two steps with gathered gradients."""
    if iteration <= ACCUMULATES_FROM:
        return 16
    return 32 if iteration <= SLOWER_FROM else 64
