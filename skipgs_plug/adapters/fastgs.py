"""FastGS: gradients accumulate over 16, 32 or 64 iterations, so only the backward may be gated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class FastGS(InriaFamily):
    """`optimizer_step(iteration)` stays untouched: it applies what the backwards since its last step left.

    It is called in skipped iterations too, where it may have the gradients of earlier ones to apply. After
    densification Gaussians are pruned at iterations 18,000, 21,000, 24,000 and 27,000.
    """

    name = "fastgs"
    checked = "fastgs/FastGS 44e02a5c (its script, run on the CPU)"
    mark = "render_fastgs"
    renders = ("render_fastgs",)

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.densify_until_iter)
