"""The training loop: the 3DGS recipe, one method per step of an iteration."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from skipgs_plug.host_copy import HostCopy
from skipgs_plug.trainer import metrics, state
from skipgs_plug.trainer.backend import Backend, resolve_backend, single_precision
from skipgs_plug.trainer.clock import TrainClock
from skipgs_plug.trainer.config import TrainConfig
from skipgs_plug.trainer.densification import densify
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.exposure import Exposure
from skipgs_plug.trainer.image_store import ReadAhead, one_by_one
from skipgs_plug.trainer.mask import leave_out
from skipgs_plug.trainer.mcmc import Mcmc
from skipgs_plug.trainer.model import create_optimizers, create_splats
from skipgs_plug.trainer.near_plane import far_plane, near_plane
from skipgs_plug.trainer.order import ViewOrder, derive_seed
from skipgs_plug.trainer.photographs import Photographs
from skipgs_plug.trainer.ply import write_ply
from skipgs_plug.trainer.row_order import sort_rows, sorts_rows
from skipgs_plug.trainer.scene import Scene, View
from skipgs_plug.trainer.state import Stateful
from skipgs_plug.trainer.strategy import create_strategy, reset_opacity_if_missed

MEANS_LR_END = 0.01  # learning rate of positions at the end of the schedule, as a share of the first; 3DGS's value
DRAWING = threading.Lock()  # held while a trainer draws random numbers: gsplat uses one generator for all threads


class Iteration(NamedTuple):
    """Facts about one iteration, for `Trainer.on_step`."""

    step: int
    since: int  # number right after the previous iteration; below `step` if a gate left out iterations between
    view: str
    loss: float
    image: Tensor  # [H, W, 3], detached
    target: Tensor  # [H, W, 3] uint8

    def passes(self, every: int) -> bool:
        """Whether this iteration, or a left-out iteration right before it, is a multiple of `every`."""
        return self.step // every > (self.since - 1) // every

    def completes(self, every: int) -> bool:
        """Whether this iteration completes a multiple of `every` iterations, left-out ones included."""
        return (self.step + 1) // every > self.since // every


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
        self.near_plane = near_plane(config, scene)
        self.far_plane = far_plane(config, scene)
        self.step = self.ran = 0
        self._since: int | None = None  # number after the previous iteration, set by `train`
        self._splats = create_splats(scene, config, self.backend.device, self.near_plane)
        self._optimizers = create_optimizers(self._splats, config, scene.scene_scale, self.backend)
        self.mcmc = Mcmc(config, scene.scene_scale) if config.strategy == "mcmc" else None
        self.strategy: Any = None
        self.strategy_state: dict[str, Any] = {}
        if self.mcmc is None:
            self.strategy = create_strategy(config)
            self.strategy.check_sanity(self._splats, self._optimizers)
            self.strategy_state = self.strategy.initialize_state(scene_scale=scene.scene_scale)
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
        self._recipe = config.recipe
        self._sh_interval = config.scaled(config.sh_degree_interval)
        self._warm = False
        self._photographs = Photographs(scene.train, self.backend.device)
        self._value: HostCopy | None = None  # loss of the present iteration
        self._colour: Tensor | None = None  # background [3]; None for black
        if any(scene.background):
            self._colour = torch.tensor(scene.background, dtype=torch.float32, device=self.backend.device)

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
        strategy = self.strategy if densifying else None
        self.set_learning_rate(step)

        self.clock.start()
        with_rows = strategy is not None or self.config.visible_adam
        image, target, info = self._forward(view, self.active_sh_degree(step), step, with_rows)
        self.clock.mark("forward")
        if strategy is not None:
            strategy.step_pre_backward(self._splats, self._optimizers, self.strategy_state, step, info)
        loss = self._loss(image, target)
        self._value = HostCopy(loss)
        self.clock.mark("loss")
        self.backward(loss, view.name, step)
        self.clock.mark("backward")
        updated = self._optimizer_step(info)
        self.clock.mark("optimizer")
        if self.mcmc is not None:
            self._move(self.mcmc, step, updated)
        # A gate may have left this iteration without gradients, which densification averages.
        elif strategy is not None and info["means2d"].grad is not None:
            self._densify(strategy, step, info)
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
        degree = self.active_sh_degree(max(self.step - 1, 0))
        image, _ = self._rasterize(view, degree, self._background())
        return self._exposed(image, view)

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
            rows = []
            for i, view in enumerate(one_by_one(views)):
                render = self.render(view)
                if keep is not None:
                    keep(i, view, render)
                image, target = leave_out(render, self._target(view).float() / 255.0, view.mask)
                rows.append(metrics.measure(wanted, image, target, view.mask))
        means = {key: sum(row[key] for row in rows) / len(rows) for key in rows[0]}
        return {
            **means,
            "num_GS": self.num_gaussians,
            "step": self.step,
            "split": split,
            "views": len(views),
            "per_view": [{"view": view.name, **row} for view, row in zip(views, rows, strict=True)],
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

    def _forward(self, view: View, degree: int, step: int, with_rows: bool) -> tuple[Tensor, Tensor, dict[str, Any]]:
        background = self._background()
        if self.config.random_bkgd:
            generator = torch.Generator().manual_seed(derive_seed(self.config.seed, step))
            background = torch.rand(3, generator=generator, dtype=torch.float32).to(self.backend.device)
        image, info = self._rasterize(view, degree, background, with_rows)
        return (*leave_out(self._exposed(image, view), self._target(view), view.mask), info)

    def _exposed(self, image: Tensor, view: View) -> Tensor:
        return image if self.exposure is None else self.exposure.apply(image, view.name)

    def _rasterize(
        self, view: View, degree: int, background: Tensor | None, with_rows: bool = False
    ) -> tuple[Tensor, dict[str, Any]]:
        return self.backend.render(
            self._splats,
            view.viewmat,
            view.K,
            background,
            antialiased=self.config.antialiased,
            with_rows=with_rows,
            width=view.width,
            height=view.height,
            sh_degree=degree,
            near_plane=self.near_plane,
            far_plane=self.far_plane,
            absgrad=self.config.absgrad,
            optimizers=self._optimizers,
        )

    def _background(self) -> Tensor | None:
        """Return the scene's background [3]; None for black, which needs no compositing."""
        return self._colour

    def _target(self, view: View) -> Tensor:
        return view.image.to(self.backend.device)

    def _loss(self, image: Tensor, target: Tensor) -> Tensor:
        loss = self.backend.loss(image, target, self.config.ssim_lambda)
        recipe = self._recipe
        if recipe.opacity_reg > 0.0:
            loss = loss + recipe.opacity_reg * torch.sigmoid(self._splats["opacities"]).mean()
        if recipe.scale_reg > 0.0:
            loss = loss + recipe.scale_reg / self.scene.scene_scale * torch.exp(self._splats["scales"]).mean()
        return loss

    def _optimizer_step(self, info: dict[str, Any]) -> bool:
        """Step all optimizers. Return whether positions were updated: a gate may leave out or postpone the update."""
        pending = self._splats["means"].grad is not None
        for optimizer in self._optimizers.values():
            if self.config.visible_adam:
                optimizer.step(self._visible(info))  # type: ignore[call-overload]
            else:
                optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if self.exposure is not None:
            self.exposure.step()
        return pending and self._splats["means"].grad is None

    def _visible(self, info: dict[str, Any]) -> Tensor:
        """Return which Gaussians the image shows [N]."""
        if info["gaussian_ids"] is None:
            return (info["radii"] > 0).all(dim=-1).any(dim=0)  # type: ignore[no-any-return]
        visible = torch.zeros(self.num_gaussians, dtype=torch.bool, device=self.backend.device)
        visible[info["gaussian_ids"]] = True
        return visible

    def _densify(self, strategy: Any, step: int, info: dict[str, Any]) -> None:
        args = (self._splats, self._optimizers, self.strategy_state, step)
        if step % strategy.refine_every:
            strategy.step_post_backward(*args, info, packed=info["gaussian_ids"] is not None)
        else:
            self._catch_up()
            with self._seeded(step):
                densify(strategy, *args, info, in_order=sorts_rows(strategy, step))
        reset_opacity_if_missed(strategy, *args)

    def _move(self, mcmc: Mcmc, step: int, updated: bool) -> None:
        # The noise belongs to the update: without an update it is a random walk.
        moves = mcmc.moves(step)
        if moves:
            self.backend.release_memory()  # gsplat copies all rows
            self._catch_up()
        if updated or moves:
            rate = self._optimizers["means"].param_groups[0]["lr"] if updated else 0.0
            with self._seeded(step):
                mcmc.after_update(self._splats, self._optimizers, step, rate)
        if sorts_rows(mcmc, step):
            sort_rows(self.splats, self.optimizers, self.strategy_state)

    def _catch_up(self) -> None:
        """Apply the missed updates of Gaussians that the last views did not show, before other code reads them."""
        self.backend.catch_up(self._optimizers)

    @contextmanager
    def _seeded(self, step: int) -> Iterator[None]:
        """Seed the global generator, which gsplat uses, for this iteration, so that a resumed run is the same run.

        The caller's random state is restored.
        """
        with DRAWING, torch.random.fork_rng(devices=self._random_devices):
            torch.manual_seed(derive_seed(self.config.seed, step))
            yield

    @property
    def _random_devices(self) -> list[torch.device]:
        """Devices whose random state is restored. Without a list, PyTorch would initialise every GPU."""
        return [] if self.backend.device.type == "cpu" else [self.backend.device]

    def _warm_up(self, view: View) -> None:
        """Compile kernels before the clock runs, by a forward and backward of each kind. Gradients are dropped.

        Densification and refinement use the same kernels, except for the adjoint with absolute gradients.
        """
        for with_rows in {True, not self.config.absgrad}:
            image, target, _ = self._forward(view, self.config.sh_degree, 0, with_rows)
            self._loss(image, target).backward()
            for optimizer in self.all_optimizers:
                optimizer.zero_grad(set_to_none=True)
        self._warm = True
