"""Look-alike of 3DGRUT's trainer: a strategy that is called around the backward, with MCMC's perturbation."""

from types import SimpleNamespace

import torch
from lookalikes.splats import NAMES, SplatModel, draw, log, make_cameras, note_step, photo_loss, pick

ADAPTER, FIRST, START, LAST = "3dgrut", 0, 20, 59


def section(start, end):
    return SimpleNamespace(start_iteration=start, end_iteration=end)


class MixtureOfGaussians(SplatModel):
    def scheduler_step(self, step):
        self.update_learning_rate(step)


class GSStrategy:
    conf = SimpleNamespace(densify=section(5, 20), prune=section(5, 18), prune_scale=section(-1, 40))

    def __init__(self, model):
        self.model = model

    def pre_backward(self, step, scene_extent, train_dataset, batch=None, writer=None):
        return False

    def post_backward(self, step, points):
        if step < 20:
            self.update_gradient_buffer(points)

    def update_gradient_buffer(self, points):
        self.model.add_densification_stats(points)

    def prune_gaussians_opacity(self):
        self.model.prune_gaussians(0.05, self.model.values["opacity"])

    def post_optimizer_step(self, step):
        if 5 < step < 20 and step % 6 == 0:
            self.prune_gaussians_opacity()


class MCMCStrategy(GSStrategy):
    conf = SimpleNamespace(relocate=section(5, 20), add=section(5, 20), perturb=section(0, 50))

    def post_backward(self, step, points):
        pass

    def perturb_gaussians(self):
        self.model.values["xyz"].data += 0.001

    def post_optimizer_step(self, step):
        super().post_optimizer_step(step)
        self.perturb_gaussians()


class Trainer3DGRUT:
    def __init__(self, strategy=GSStrategy):
        self.model = MixtureOfGaussians()
        self.model.training_setup()
        self.strategy = strategy(self.model)
        self.cameras = make_cameras()
        self.train_dataset = SimpleNamespace(image_paths=list(NAMES))
        self.conf = SimpleNamespace(strategy=strategy.conf, n_iterations=LAST + 1)
        self.tracking = SimpleNamespace(output_dir="results")
        self.global_step = 0

    def run_train_iter(self, global_step, batch, profilers, metrics, conf):
        log.begins(global_step, self.model.values.values())
        gpu_batch = SimpleNamespace(frame_idx=NAMES.index(batch.image_name))
        if global_step % 10 == 0:
            with torch.no_grad():
                draw(self.cameras[0], self.model.values)  # validation
        outputs = draw(batch, self.model.values)
        batch_losses = {"total_loss": photo_loss(outputs["render"], batch)}
        self.strategy.pre_backward(
            step=global_step, scene_extent=1.0, train_dataset=self.train_dataset, batch=gpu_batch, writer=None
        )
        batch_losses["total_loss"].backward()
        self.strategy.post_backward(global_step, outputs["viewspace_points"])
        note_step([self.model.optimizer])
        self.model.optimizer.step()
        self.model.optimizer.zero_grad()
        self.model.scheduler_step(global_step)
        self.strategy.post_optimizer_step(global_step)
        self.global_step = global_step + 1

    def run_training(self, last=LAST):
        while self.global_step <= last:
            self.run_train_iter(self.global_step, pick(self.cameras, self.global_step), None, [], self.conf)
        return self
