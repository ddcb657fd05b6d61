"""GaussianSpa: train_imp_score.py, train_opacity.py and train_op.py, with an ADMM phase after densification."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class GaussianSpa(InriaFamily):
    """Gated after the sparsifying phase, whose alternation of steps must stay as it is.

    That phase ends with a prune in the last iteration before the gate begins. A gate that the user starts earlier runs
    every iteration with the ADMM term in its loss, and keeps these losses out of the means. The adapter counts
    iterations itself, since `update_learning_rate` gets shifted numbers. With `share`, all iterations of the phase run:
    its terms pull at the model, and the iterations between them pull back.
    """

    name = "gaussianspa"
    checked = "noodle-lab/GaussianSpa abdfaf64 (its three scripts run)"
    project = "[GaussianSpa](https://github.com/noodle-lab/GaussianSpa)"
    gated = "From `optimizing_spa_stop_iter` + 1 on, after a pause for the prune in the iteration before."
    with_share = (
        "By visits. All iterations of the sparsifying phase run: its terms pull at the model, and the iterations "
        "between them pull back."
    )
    left_alone = (
        "A gate that you start earlier runs all iterations with the ADMM term and keeps their losses out of the means."
    )
    stand_ins = "gaussianspa"
    mark = "OptimizingSpa"
    needs = ("optimizing_spa_start_iter", "optimizing_spa_stop_iter", "optimizing_spa_interval")
    changes = (*InriaFamily.changes, "densify_and_prune_split")
    renders = ("render_imp", "render")
    structural = (*InriaFamily.structural, "reinitial_pts")

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._admm = range(0)  # iterations whose loss holds the term
        self._phase = range(0)

    def begin(self, opt: Any, loop: Mapping[str, Any]) -> None:
        first, last = int(opt.optimizing_spa_start_iter) + 1, int(opt.optimizing_spa_stop_iter)
        interval = int(opt.optimizing_spa_interval)
        # The scripts disagree whether the last of these iterations has the term. It runs in any case.
        self._admm = range(first + -first % interval, last + 1, interval)
        self._phase = range(first - 1, last + 1)

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return max(int(opt.optimizing_spa_stop_iter) + 1, int(opt.densify_until_iter))

    def always_run(self, numbers: range) -> Iterable[int]:
        """Return the iterations of the sparsifying phase."""
        return (n for n in numbers if n in self._phase)

    def must_run(self, step: int) -> bool:
        return step in self._admm
