"""FastGS: gradients accumulate over 16, 32 or 64 iterations, so only the backward may be gated."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from skipgs_plug.adapters.inria import GROWS_WHOLE, RESETS, InriaFamily
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import Densification

# Constants of `optimizer_step`: iterations after which it steps every 32nd, then every 64th iteration. Before that, one
# optimizer steps in each iteration and the one of higher bands in each 16th, so both step in iteration 16.
ACCUMULATES_FROM = 15_000
SLOWER_FROM = 20_000
BOTH_STEP = 16


class FastGS(InriaFamily):
    """`optimizer_step(iteration)` applies the gradients gathered since its last step, in the paper's gate as upstream.

    It is called in skipped iterations too, and may apply gradients of earlier iterations there. With `share` or
    `refine_share` few iterations of refinement run, and they step as in densification: `optimizer_step` gets a number
    with which one optimizer steps in each of them, and that of the higher bands in each 16th. The rate of the higher
    bands is made for such rare steps. With a step in each iteration, bonsai (200x133) lost 1.3 dB. In schedules of
    30,000 iterations, 15,000 of FastGS' 15,312 steps are in densification. All of it runs: with 70 % of its iterations
    fern (126x94) lost 0.4 dB.
    """

    name = "fastgs"
    checked = "fastgs/FastGS 44e02a5c (its script run)"
    project = "[FastGS](https://github.com/fastgs/FastGS)"
    gated = "From `densify_until_iter` on. The prunes at 18,000, 21,000, 24,000 and 27,000 pause the gate."
    left_alone = (
        "The paper's gate: `optimizer_step(iteration)` steps every 16th, 32nd or 64th iteration with the gradients "
        "gathered since, even in a skipped one."
    )
    with_share = f"Refinement steps as densification does, higher bands in every 16th iteration. {GROWS_WHOLE}"
    stand_ins = "fastgs"
    mark = "render_fastgs"
    changes = (*InriaFamily.changes, "densify_and_prune_fastgs")
    pausing = ("final_prune_fastgs",)
    calls = ("optimizer_step",)
    arguments = ("get_flag", "metric_map")
    renders = ("render_fastgs",)
    # Each event caps opacities at 0.8 and replaces their moments.
    densification = Densification(marks=("densification_interval",), reset_marks=RESETS, clears_moments=True)

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._each = False  # whether refinement steps in each iteration that runs

    def _attach_to_model(self, hooks: Hooks, names: dict[str, Any]) -> None:
        super()._attach_to_model(hooks, names)
        self._each = hooks.lengthens_steps
        if not self._each:
            return

        refined = itertools.count(1)

        def stepped(original: Callable[..., Any], model: Any, iteration: int) -> Any:
            if iteration > ACCUMULATES_FROM:
                iteration = BOTH_STEP if next(refined) % BOTH_STEP == 0 else 1
            return original(model, iteration)

        hooks.wrap(names["GaussianModel"], "optimizer_step", stepped)

    def accumulates(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        return not self._each and self._few_steps(opt, loop)

    def steps_each(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        return self._each and self._few_steps(opt, loop)

    def _few_steps(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        """Whether the script's own refinement accumulates gradients, from its first iteration on."""
        default = getattr(opt, "optimizer_type", "default") == "default"
        return default and self.start_iter(opt, loop) >= ACCUMULATES_FROM

    def always_run(self, numbers: range) -> Iterable[int]:
        """Return the iterations in which `optimizer_step` steps with gathered gradients."""
        return () if self._each else (n for n in numbers if n % interval(n) == 0)


def interval(iteration: int) -> int:
    """Return the number of iterations between two steps with gathered gradients."""
    if iteration <= ACCUMULATES_FROM:
        return BOTH_STEP
    return 32 if iteration <= SLOWER_FROM else 64
