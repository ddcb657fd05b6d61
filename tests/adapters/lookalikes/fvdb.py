"""Look-alike of fVDB Reality Capture's runner: minibatches of a DataLoader, opacities reset until the end."""

from types import SimpleNamespace

import torch
from lookalikes.splats import NAMES, SplatModel, draw, log, make_cameras, note_step, photo_loss

ADAPTER, FIRST, START, LAST = "fvdb", 0, 20, 59


class Views(torch.utils.data.Dataset):
    def __len__(self):
        return len(NAMES)

    def __getitem__(self, index):
        return {"image_id": index}


class Order(torch.utils.data.Sampler):
    """A new order in each epoch, the same in a resumed run."""

    def __init__(self):
        self.epoch = 0

    def __iter__(self):
        self.epoch += 1
        return iter(torch.randperm(len(NAMES), generator=torch.Generator().manual_seed(self.epoch)).tolist())

    def __len__(self):
        return len(NAMES)


class GaussianSplatOptimizer:
    def __init__(self, model):
        self.model = model

    def refine_gaussians(self):
        self.model.prune_gaussians(0.05, self.model.values["opacity"])

    def reset_opacities(self):
        self.model.reset_opacity()

    def step(self):
        note_step([self.model.optimizer])
        self.model.optimizer.step()

    def zero_grad(self, set_to_none=False):
        self.model.optimizer.zero_grad(set_to_none=set_to_none)


class SceneOptimizationRunner:
    def __init__(self):
        self.config = SimpleNamespace(
            batch_size=1, crops_per_image=1, refine_stop_epoch=4, optimize_camera_poses=False, max_steps=None
        )
        self.config.max_epochs = 12
        self.model = SplatModel()
        self.model.training_setup()
        self.optimizer = GaussianSplatOptimizer(self.model)
        self.training_dataset, self.checkpoints_path = Views(), "results"
        self.cameras = {camera.image_name: camera for camera in make_cameras()}
        self._global_step = self._start_step = 0

    def train(self, last=LAST):
        trainloader = torch.utils.data.DataLoader(self.training_dataset, batch_size=1, sampler=Order())
        self.optimizer.zero_grad()
        self._global_step = 0
        for _ in range(self.config.max_epochs):
            for minibatch in trainloader:
                if self._global_step > last:
                    return self
                if self._global_step < self._start_step:
                    self._global_step += 1
                    continue
                log.begins(self._global_step, self.model.values.values())
                camera = self.cameras[NAMES[int(minibatch["image_id"])]]
                rendered = draw(camera, self.model.values)
                loss = photo_loss(rendered["render"], camera)
                loss.backward(retain_graph=False)
                if self._global_step < 20:
                    self.model.add_densification_stats(rendered["viewspace_points"])
                    if self._global_step > 3 and self._global_step % 6 == 0:
                        self.optimizer.refine_gaussians()
                if self._global_step % 25 == 0 and self._global_step > 0:
                    self.optimizer.reset_opacities()
                self.optimizer.step()
                self.optimizer.zero_grad(set_to_none=True)
                self._global_step += 1
        return self
