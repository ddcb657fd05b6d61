"""Look-alike of the runner of fVDB's command frgs: an optimizer that refines and resets by itself, or MCMC's noise."""

from types import SimpleNamespace

import torch
from lookalikes.fvdb import GaussianSplatOptimizer, Order, Views
from lookalikes.splats import NAMES, SplatModel, draw, log, make_cameras, photo_loss

ADAPTER, FIRST, START, LAST = "fvdb", 0, 20, 59


class GaussianSplat3d(SplatModel):
    def add_noise_to_means(self, noise_scale):
        with torch.no_grad():
            self.values["xyz"] += noise_scale * torch.randn_like(self.values["xyz"])


class Optimizer(GaussianSplatOptimizer):
    refined = 0

    def refine(self):
        self.filter_gaussians(self.model.values["opacity"][:, 0] > self.model.values["opacity"].quantile(0.05))
        self.refined += 1
        if self.refined % 2 == 0:
            self.model.reset_opacity()

    def filter_gaussians(self, kept):
        self.model.prune_points(~kept)

    def regularization_loss(self):
        return 0.01 * torch.exp(self.model.values["scaling"]).mean()


class OptimizerMCMC(Optimizer):
    def step(self):
        self.model.add_noise_to_means(0.01)
        super().step()


class GaussianSplatReconstruction:
    def __init__(self, optimizer=Optimizer, batch_size=1):
        self.config = SimpleNamespace(
            batch_size=batch_size, crops_per_image=1, refine_stop_epoch=4, optimize_camera_poses=False, max_steps=None
        )
        self.config.max_epochs = 12 * batch_size
        self.model = GaussianSplat3d()
        self.model.training_setup()
        self.optimizer = optimizer(self.model)
        self.training_dataset, self._writer = Views(), SimpleNamespace(log_path="results")
        self.cameras = {camera.image_name: camera for camera in make_cameras()}
        self._global_step = self._start_step = 0

    def optimize(self, last=LAST):
        batch_size = self.config.batch_size
        trainloader = torch.utils.data.DataLoader(self.training_dataset, batch_size=batch_size, sampler=Order())
        refine_stop_step = int(self.config.refine_stop_epoch * len(trainloader))
        self.optimizer.zero_grad()
        for _ in range(self.config.max_epochs):
            for minibatch in trainloader:
                if self._global_step > last:
                    return
                log.begins(self._global_step, self.model.values.values())
                cameras = [self.cameras[NAMES[int(number)]] for number in minibatch["image_id"]]
                out = [draw(camera, self.model.values, None if i else True) for i, camera in enumerate(cameras)]
                loss = sum(photo_loss(one["render"], camera) for one, camera in zip(out, cameras, strict=True))
                loss = loss + self.optimizer.regularization_loss()
                loss.backward(retain_graph=False)
                if self._global_step > 3 and self._global_step % 6 == 0 and self._global_step < refine_stop_step:
                    self.optimizer.refine()
                self.optimizer.step()
                self.optimizer.zero_grad(set_to_none=True)
                self._global_step += 1
