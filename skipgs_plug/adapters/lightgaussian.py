"""LightGaussian: train_densify_prune.py, prune_finetune.py and distill_train.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class LightGaussian(InriaFamily):
    """Fine-tuning and distilling are gated from the beginning, training from scratch after densification.

    prune_finetune.py usually prunes in its first iteration, after the backward. The gate then begins with the second
    iteration, and with a pause. distill_train.py jitters the camera in two of three iterations. Losses of a jittered
    camera scatter more than those of the camera itself, so the two have separate means.
    """

    name = "lightgaussian"
    checked = "VITA-Group/LightGaussian 6676b983 (its three scripts run)"
    project = "[LightGaussian](https://github.com/VITA-Group/LightGaussian)"
    gated = (
        "`prune_finetune.py`: from the second iteration of the run on, after a pause, since the first one prunes. "
        "`train_densify_prune.py`: from `densify_until_iter` on; later prunes pause the gate. `distill_train.py`: from "
        "the first iteration on."
    )
    with_share = (
        "`train_densify_prune.py`: by visits; refinement begins after the last of `prune_iterations`. The other two "
        "scripts do not densify."
    )
    left_alone = "With `--augmented_view`, jittered cameras (two of three iterations) have means of their own."
    stand_ins = "lightgaussian"
    mark = "calculate_v_imp_score"
    pausing = ("prune_gaussians",)
    calls = ("onedownSHdegree", "load_ply", "randn")
    scenes = ("scene", "student_scene")

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._jitters = False

    def begin(self, opt: Any, loop: Mapping[str, Any]) -> None:
        self._jitters = distills(loop) and loop["args"].augmented_view

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        first = int(loop["iteration"])
        if distills(loop):
            return first
        if finetunes(loop):
            return first + (first in loop["args"].prune_iterations)
        return int(opt.densify_until_iter)

    def settled_iter(self, opt: Any, loop: Mapping[str, Any]) -> int | None:
        if distills(loop) or finetunes(loop):
            return None
        pruned = (int(number) for number in loop["args"].prune_iterations)
        return max((number + 1 for number in pruned if number < int(opt.iterations)), default=None)

    def gradients_read_until(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return 0 if distills(loop) or finetunes(loop) else int(opt.densify_until_iter)

    def view_key(self, camera: Any) -> Any:
        key = super().view_key(camera)
        return (key, "jittered") if self._jitters and self._step % 3 and key is not None else key

    def view_keys(self, cameras: Sequence[Any]) -> list[Any]:
        keys = super().view_keys(cameras)
        return keys + [(key, "jittered") for key in keys] if self._jitters else keys


def finetunes(loop: Mapping[str, Any]) -> bool:
    """Whether these names are from prune_finetune.py: only this script can start from a point cloud."""
    return hasattr(loop.get("args"), "start_pointcloud")


def distills(loop: Mapping[str, Any]) -> bool:
    """Whether these names are from distill_train.py: only this script has two models."""
    return "teacher_gaussians" in loop
