"""The training loop: the 3DGS recipe, one method per step of an iteration."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from skipgs_plug.host_copy import HostCopy
from skipgs_plug.trainer import metrics, state
from skipgs_plug.trainer.backend import Backend, resolve_backend, single_precision
from skipgs_plug.trainer.clear_views import ClearViews
from skipgs_plug.trainer.clock import TrainClock
from skipgs_plug.trainer.config import TrainConfig
from skipgs_plug.trainer.densifier import Densifier
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.evaluation import evaluate
from skipgs_plug.trainer.exposure import Exposure
from skipgs_plug.trainer.half_size import half_size
from skipgs_plug.trainer.image_store import ReadAhead
from skipgs_plug.trainer.iteration import Iteration
from skipgs_plug.trainer.model import create_optimizers, create_splats, step_optimizers
from skipgs_plug.trainer.near_plane import near_plane, nearest_depths
from skipgs_plug.trainer.order import ViewOrder
from skipgs_plug.trainer.photographs import Photographs
from skipgs_plug.trainer.ply import write_ply
from skipgs_plug.trainer.rendering import ViewRenderer
from skipgs_plug.trainer.scene import Scene, View
from skipgs_plug.trainer.state import Stateful
from skipgs_plug.trainer.strategy import resets_in

MEANS_LR_END = 0.01  # learning rate of positions at the end of the schedule, as a share of the first; 3DGS's value


class Trainer:
    """Trains one scene by the 3DGS recipe.

    Args:
        config: Settings.
        scene: The scene, with at least one training view.
        backend: Renders and optimizes; None for the one that `config.backend` names.

    Attributes:
        step: Next iteration, from 0.
        ran: Number of iterations that ran. It is less than `step` when a gate leaves some out. Views take turns
            among the iterations that run.
        strategy: gsplat's DefaultStrategy, or None with `mcmc`.
        exposure: Colour correction of each photograph, with an optimizer of its own; None without `config.exposure`.
        refine_stop_iter: Iteration at which densification ends.
        near_plane: Near clipping plane, in the units of `scene.frame`, like the Gaussians.
        on_step: Called after every iteration, outside the clock.
        stop_requested: Set it, for example in a signal handler, to end `train` after the current iteration.

    Examples:
        >>> from skipgs_plug import SkipGate
        >>> from skipgs_plug.trainer import TrainConfig, Trainer
        >>> from skipgs_plug.trainer.synthetic import make_scene
        >>> scene = make_scene(n_views=10, width=32, height=24, n_points=160)
        >>> trainer = Trainer(TrainConfig(max_steps=40), scene)
        >>> with SkipGate(trainer, refine_share=0.4) as gate:
        ...     trainer.train(progress=False)
        >>> trainer.step, gate.stats()["iterations_run"]
        (40, 9)
    """

    @single_precision()
    def __init__(self, config: TrainConfig, scene: Scene, backend: Backend | None = None) -> None:
        self.config = config
        self.scene = scene
        self.backend = backend or resolve_backend(config.backend)
        self.max_steps = config.max_steps
        depths = nearest_depths(scene.train, scene.points)
        self.near_plane = near_plane(config, scene, depths)
        self.step = self.ran = 0
        self._since: int | None = None  # number after the previous iteration, set by `train`
        self._splats = create_splats(scene, config, self.backend.device, self.near_plane)
        self._optimizers = create_optimizers(self._splats, config, scene.scene_scale, self.backend)
        clear = ClearViews(scene.train, depths, config.clear_depth)
        self._densifier = Densifier(config, scene.scene_scale, clear, self.backend, self._splats, self._optimizers)
        self.mcmc, self.strategy = self._densifier.mcmc, self._densifier.strategy
        self.strategy_state = self._densifier.state
        self.refine_stop_iter = config.scaled(config.recipe.refine_stop_iter)
        self.view_names = [view.name for view in scene.train]
        self.clock = TrainClock(self.backend.device)
        self.registered: dict[str, Stateful] = {}
        self.exposure = Exposure(self.view_names, self.backend.device) if config.exposure else None
        if self.exposure is not None:
            self.register_state("exposure", self.exposure)
        self.on_step: Callable[[Iteration], None] | None = None
        self.stop_requested = False
        self._order = ViewOrder(len(scene.train), config.seed)
        self._read_ahead = ReadAhead(scene.train, config.seed)
        self._sh_interval = config.scaled(config.sh_degree_interval)
        self._warm = False
        self._photographs = Photographs(scene.train, self.backend.device)
        self._value: HostCopy | None = None  # loss of the present iteration
        self._renderer = ViewRenderer(
            config, scene, self.backend, self._splats, self._optimizers, self.exposure, self.near_plane
        )

    @property
    def splats(self) -> nn.ParameterDict:
        """Current raw parameters `means scales quats opacities sh0 shN`, in coordinates of `scene.frame`."""
        self._catch_up()
        return self._splats

    @property
    def optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """One optimizer per parameter, by the same names. Moments are up to date until the next iteration."""
        self._catch_up()
        return self._optimizers

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians. This is cheap: unlike `splats`, it brings no parameter up to date."""
        return len(self._splats["means"])

    @property
    def all_optimizers(self) -> list[torch.optim.Optimizer]:
        """Optimizers of the Gaussians and of the exposure. Unlike those of `optimizers`, moments may lag behind."""
        return [*self._optimizers.values(), *([] if self.exposure is None else [self.exposure.optimizer])]

    @property
    def phase_seconds(self) -> dict[str, float]:
        """Seconds of training by phase: forward, loss, backward, optimizer, strategy; 0 if not measured."""
        return self.clock.phase_seconds

    @property
    def t_total(self) -> float:
        """Seconds of training, without evaluation, saving and kernel compilation."""
        return self.clock.t_total

    @property
    def t_post(self) -> float:
        """The part of `t_total` after densification ended."""
        return self.clock.t_post

    def train(self, until: int | None = None, progress: bool = True) -> None:
        """Run iterations; fewer when `stop_requested` is set.

        Args:
            until: Iteration before which training stops; None for `max_steps`, which is also the largest.
            progress: Show a progress bar.

        Raises:
            InputError: A loss is not finite.
        """
        from tqdm.auto import tqdm

        until = self.max_steps if until is None else min(until, self.max_steps)
        bar = tqdm(total=until, initial=self.step, desc="Training", disable=not progress, mininterval=0.5)
        with bar:
            for step in () if self.stop_requested else self.iterations(until):
                before, self.step = self.step, step
                self._since = before
                loss = self.train_step()
                # Outside of the iteration, since it raises if the reader of the output is gone.
                bar.update(self.step - before)
                if self.ran % 10 == 0:
                    bar.set_postfix_str(f"loss={loss:.3f} | GS={self.num_gaussians}", refresh=False)
                if self.stop_requested:
                    break
            else:  # the last iterations may have been left out
                self.step = self.step if self.stop_requested else max(self.step, until)
        self.stop_requested = False
        self.clock.settle()
        self._read_ahead.end()
        self._catch_up()

    def iterations(self, until: int) -> range:
        """Return the numbers of the iterations to run. A gate replaces this method to leave some out.

        Args:
            until: Iteration before which training stops.
        """
        return range(self.step, until)

    def resets_opacities(self, step: int) -> bool:
        """Whether opacities are reset in an iteration."""
        return self.strategy is not None and resets_in(self.strategy, step)

    @single_precision()
    def train_step(self) -> float:
        """Run one iteration and return its loss.

        Raises:
            InputError: The loss is not finite.
        """
        with self.backend.exclusive_cores():
            return self._train_step()

    def _train_step(self) -> float:
        step = self.step
        self._read_ahead.expect(self.ran)
        view = self._photographs.on_device(self.scene.train[self._order.at(self.ran)])
        self._photographs.begin(self.scene.train[self._order.at(self.ran + 1)])
        if not self._warm:
            self._warm_up(view)
        densifying = step < self.refine_stop_iter
        if self.at_half_size():
            view = half_size(view)
        self.set_learning_rate(step)

        self.clock.start()
        with_rows = (densifying and self.mcmc is None) or self.config.visible_adam
        image, target, info = self._renderer.forward(view, self.active_sh_degree(step), step, with_rows)
        self.clock.mark("forward")
        self._densifier.before_backward(step, info)
        loss = self._renderer.loss(image, target)
        self._value = HostCopy(loss)
        self.clock.mark("loss")
        self.backward(loss, view.name, step)
        self.clock.mark("backward")
        # A gate may leave out or postpone the update.
        updated = step_optimizers(self._splats, self._optimizers, info if self.config.visible_adam else None)
        if self.exposure is not None:
            self.exposure.step()
        self.clock.mark("optimizer")
        self._densifier.after_update(step, info, updated)
        self.clock.mark("strategy")
        self.clock.stop(after_densification=not densifying)
        value = self._value.value()
        self._value = None

        self.step += 1
        self.ran += 1
        since, self._since = step if self._since is None else self._since, None
        if self.on_step is not None:
            self.on_step(Iteration(step, since, view.name, value, image.detach(), target))
        return value

    def backward(self, loss: Tensor, view: str, step: int) -> None:
        """Compute gradients, once per iteration. A gate replaces this method on the instance.

        Args:
            loss: Scalar loss of the view.
            view: Name of the view.
            step: Number of the iteration.

        Raises:
            InputError: The loss is not finite. The message names view and step.
        """
        value = self._value if self._value is not None else HostCopy(loss)
        if value.is_under_way:  # the device computes gradients while the loss is copied
            loss.backward()
            self._require_finite(value, view, step)
        else:
            self._require_finite(value, view, step)
            loss.backward()

    @staticmethod
    def _require_finite(value: HostCopy, view: str, step: int) -> None:
        if not math.isfinite(value.value()):
            raise InputError(
                f"Loss is {value.value()} at iteration {step} on view {view!r}; check that image and camera, or lower "
                "the learning rates."
            )

    def at_half_size(self) -> bool:
        """Whether the present iteration trains on a photograph of half the width and height. A gate may replace it."""
        return False

    def set_learning_rate(self, step: float) -> None:
        """Set the learning rates of positions and exposure; the others are constant.

        Args:
            step: Iteration to take the rates of. A fraction is a point between two iterations.
        """
        progress = min(step / self.config.schedule, 1.0)
        rate = self.config.means_lr * self.scene.scene_scale * MEANS_LR_END**progress
        self._optimizers["means"].param_groups[0]["lr"] = rate
        if self.exposure is not None:
            self.exposure.set_learning_rate(progress)

    def active_sh_degree(self, step: int) -> int:
        """Return the SH degree that an iteration renders with.

        Args:
            step: Number of the iteration.
        """
        return min(step // self._sh_interval, self.config.sh_degree)

    @torch.no_grad()
    @single_precision()
    def render(self, view: View) -> Tensor:
        """Return the image [H, W, 3] float32 of a view, in [0, 1] up to overshoot.

        Args:
            view: Camera and size of the image. A training view gets its exposure.
        """
        return self._renderer.render(view, self.active_sh_degree(max(self.step - 1, 0)))

    @single_precision()
    def evaluate(
        self,
        split: str = "test",
        lpips_net: str | None = None,
        keep: Callable[[int, View, Tensor], object] | None = None,
    ) -> dict[str, Any]:
        """Return the means of the chosen metrics over the views of "test" or "train", with the number of Gaussians.

        Args:
            split: "test" or "train".
            lpips_net: Backbone of LPIPS, which is measured too if one is named.
            keep: Called for each view with its number, the view and its render [H, W, 3].

        Returns:
            The means by name, their flavours, `num_GS step split views`, and `per_view`: the metrics of each view.

        Raises:
            InputError: The scene has no views of this split.
        """
        views = {"test": self.scene.test, "train": self.scene.train}[split]
        if not views:
            raise InputError(f"Scene {self.scene.name} has no {split} views; lower test_every to hold some out.")
        self.clock.settle()
        wanted = metrics.chosen(lpips_net, fitted=self.exposure is not None and split == "test")
        with self.backend.exclusive_cores():
            means, per_view = evaluate(views, wanted, self.render, self._renderer.target, keep)
        return {
            **means,
            "num_GS": self.num_gaussians,
            "step": self.step,
            "split": split,
            "views": len(views),
            "per_view": per_view,
            **{f"{metric.name}_flavour": metric.flavour for metric in wanted},
        }

    def export_ply(self, path: str | Path) -> None:
        """Write the 62-property INRIA PLY, in the coordinates of the dataset.

        Args:
            path: The file.
        """
        write_ply(self.scene.frame.dataset_splats(dict(self.splats.items())), path)

    def register_state(self, name: str, owner: Stateful) -> None:
        """Store the state of another object in snapshots and checkpoints.

        Args:
            name: Name of the entry.
            owner: Object with `state_dict` and `load_state_dict`.
        """
        self.registered[name] = owner

    def snapshot(self) -> dict[str, Any]:
        """Return an exact copy of the training state, in memory."""
        self.clock.settle()
        return state.capture(self)

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot. The snapshot can be restored again later.

        Args:
            snapshot: Result of `snapshot()` of a trainer with the same scene and settings.
        """
        state.apply(self, snapshot)

    def save_checkpoint(self, path: str | Path) -> None:
        """Write a checkpoint from which `load_checkpoint` continues exactly.

        Args:
            path: The file.
        """
        self.clock.settle()
        state.save_checkpoint(self, path)

    def load_checkpoint(self, path: str | Path) -> None:
        """Continue from a checkpoint of the same scene and settings.

        Args:
            path: A file of `save_checkpoint`.

        Raises:
            MissingFileError: The file does not exist.
            DamagedCheckpointError: The file is damaged or holds NaN.
            InputError: It belongs to another scene or to other settings.
        """
        state.load_checkpoint(self, path)

    def _catch_up(self) -> None:
        """Apply the missed updates of Gaussians that the last views did not show, before other code reads them."""
        self.backend.catch_up(self._optimizers)

    def _warm_up(self, view: View) -> None:
        """Compile kernels before the clock runs, by a forward and backward of each kind. Gradients are dropped.

        Densification and refinement use the same kernels, except for the adjoint with absolute gradients.
        """
        for with_rows in {True, not self.config.absgrad}:
            image, target, _ = self._renderer.forward(view, self.config.sh_degree, 0, with_rows)
            self._renderer.loss(image, target).backward()
            for optimizer in self.all_optimizers:
                optimizer.zero_grad(set_to_none=True)
        self._warm = True
