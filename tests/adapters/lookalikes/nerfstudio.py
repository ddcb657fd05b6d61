"""Look-alike of nerfstudio's Trainer with splatfacto: zeroes first, steps optimizers with a gradient only."""

import functools
from pathlib import Path
from types import SimpleNamespace

import torch
from lookalikes.gsplat_runner import DefaultStrategy, MCMCStrategy
from lookalikes.splats import NAMES, SplatModel, draw, log, make_cameras, note_step, photo_loss, pick

ADAPTER, FIRST, START, LAST = "nerfstudio", 0, 20, 59


class DataManager:
    def __init__(self):
        self.train_dataset = SimpleNamespace(image_filenames=[Path("/data/scene") / name for name in NAMES])
        self.cameras = make_cameras()

    def next_train(self, step):
        camera = pick(self.cameras, step)
        return camera, {"image_idx": NAMES.index(camera.image_name), "image": camera.original_image}


class Model:
    def __init__(self, strategy):
        self.values, self.strategy, self.strategy_state = SplatModel().values, strategy, {}

    def step_post_backward(self, step):
        own = {"packed": False} if isinstance(self.strategy, DefaultStrategy) else {"lr": 0.01}
        self.strategy.step_post_backward(self.values, None, self.strategy_state, step, self.info, **own)


class Pipeline:
    def __init__(self, strategy):
        self.datamanager, self.model = DataManager(), Model(strategy)

    def get_train_loss_dict(self, step):
        camera, _ = self.datamanager.next_train(step)
        outputs = draw(camera, self.model.values)
        self.model.info = {"means2d": outputs["viewspace_points"]}
        losses = {"main_loss": photo_loss(outputs["render"], camera)}
        every_tenth = 10.0 if step % 10 == 0 else 0.0
        losses["scale_reg"] = every_tenth * self.model.values["scaling"].exp().mean()
        return outputs, losses, {}


class Trainer:
    def __init__(self, strategy=None, max_norm=None, accumulate=1, scaled=False, world_size=1):
        self.strategy = strategy or DefaultStrategy()
        self.config = SimpleNamespace(
            max_num_iterations=LAST + 1,
            steps_per_eval_batch=25,
            steps_per_eval_image=50,
            steps_per_eval_all_images=0,
            gradient_accumulation_steps={"xyz": accumulate},
        )
        self.world_size, self.max_norm, self.accumulate = world_size, max_norm, accumulate
        self.grad_scaler = torch.amp.GradScaler("cpu", enabled=scaled)
        self.base_dir = Path("output")
        self.start_step = 0  # later when resumed

    def setup(self):
        self.pipeline = Pipeline(self.strategy)
        values = self.pipeline.model.values
        by_name = {name: torch.optim.Adam([value], lr=0.02, eps=1e-15) for name, value in values.items()}
        self.optimizers = SimpleNamespace(optimizers=by_name)
        self.callbacks = [self.pipeline.model.step_post_backward]  # bound here, before any gate is attached
        self.schedulers = [torch.optim.lr_scheduler.ExponentialLR(self.optimizers.optimizers["xyz"], gamma=0.99)]
        return self

    def train(self, last=LAST):
        for step in range(self.start_step, last + 1):
            log.begins(step, self.pipeline.model.values.values())
            self.train_iteration(step)
            for callback in self.callbacks:
                callback(step)

    def train_iteration(self, step):
        if step % self.accumulate == 0:
            for optimizer in self.optimizers.optimizers.values():
                optimizer.zero_grad()
        _, loss_dict, _ = self.pipeline.get_train_loss_dict(step=step)
        loss = functools.reduce(torch.add, loss_dict.values())
        self.grad_scaler.scale(loss).backward()
        if step % self.accumulate == self.accumulate - 1:
            note_step(self.optimizers.optimizers.values())
            for optimizer in self.optimizers.optimizers.values():
                if self.max_norm is not None:
                    self.grad_scaler.unscale_(optimizer)
                    torch.nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], self.max_norm)
                if any(p.grad is not None for group in optimizer.param_groups for p in group["params"]):
                    self.grad_scaler.step(optimizer)
        self.grad_scaler.update()
        if step >= self.accumulate:
            self.scheduler_step_all()

    def scheduler_step_all(self):
        for scheduler in self.schedulers:
            scheduler.step()


MCMC = MCMCStrategy
