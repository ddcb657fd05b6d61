"""Look-alike of EDGS's trainer: steps counted apart from the progress bar, pruned after each until densifying ends."""

from types import SimpleNamespace

import torch
from lookalikes.splats import SplatModel, draw, log, make_cameras, note_step, photo_loss, pick

ADAPTER, FIRST, START, LAST = "edgs", 1, 20, 59


class Warper3DGS(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.gaussians = SplatModel()
        self.gaussians.training_setup()
        cameras = make_cameras()
        self.scene = SimpleNamespace(getTrainCameras=lambda: cameras, model_path="results")

    def forward(self, viewpoint_cam=None):
        return draw(viewpoint_cam, self.gaussians.values)


class EDGSTrainer:
    def __init__(self):
        self.GS = Warper3DGS()
        self.scene, self.gaussians = self.GS.scene, self.GS.gaussians
        self.training_config = SimpleNamespace(densify_until_iter=20)
        self.GS_optimizer = self.gaussians.optimizer
        self.training_step, self.gs_step = 1, 0

    def train(self, last=LAST):
        progress_bar = iter(range(self.training_step, last + 1))
        for self.training_step in progress_bar:
            self.train_step_gs()
            with torch.no_grad():
                self.prune()
                if self.training_step % 10 == 0:
                    self.GS(viewpoint_cam=self.scene.getTrainCameras()[0])  # evaluation
        self.training_step += 1
        return self

    def train_step_gs(self):
        self.gs_step += 1
        log.begins(self.gs_step, self.gaussians.values.values())
        self.gaussians.update_learning_rate(self.gs_step)
        viewpoint_cam = pick(self.scene.getTrainCameras(), self.gs_step)
        rendered = self.GS(viewpoint_cam=viewpoint_cam)
        loss = photo_loss(rendered["render"], viewpoint_cam)
        self.GS_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        with torch.no_grad():
            if self.gs_step < self.training_config.densify_until_iter:
                self.gaussians.add_densification_stats(rendered["viewspace_points"])
        note_step([self.GS_optimizer])
        self.GS_optimizer.step()
        self.GS_optimizer.zero_grad(set_to_none=True)

    def prune(self):
        if self.gs_step < self.training_config.densify_until_iter:
            self.gaussians.prune_points(self.gaussians.values["opacity"][:, 0] < 0.005)
