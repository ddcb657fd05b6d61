"""Look-alike of Improved-GS's train.py: edge scores while it densifies, then steps every 4th and 8th iteration."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, photo_loss, pick

ADAPTER, FIRST, START, LAST = "improved_gs", 1, 20, 64


class GaussianModel(SplatModel):
    def training_setup(self, opt=None):
        self.optimizer = self.adam([self.group(name) for name in self.rates if name != "f_rest"], eps=1e-15)
        self.shoptimizer = self.adam([self.group("f_rest")], eps=1e-15)

    def _optimizers(self):
        return [self.optimizer, self.shoptimizer]

    def add_densification_stats_abs(self, viewspace_points):
        self.add_densification_stats(viewspace_points)

    def only_prune(self, share):
        self._prune_gaussians(share, self.values["opacity"])


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, override_color=None, pixel_weights=None):
    return draw(viewpoint_camera, pc.values) | {"accum_weights": pc.values["opacity"].detach()}


def compute_edge_score(camlist, gaussians, pipe, bg):
    pictures = [render(camera, gaussians, pipe, bg, pixel_weights=camera.original_image) for camera in camlist]
    return sum(picture["accum_weights"] for picture in pictures)


def step(gaussians):
    note_step(gaussians._optimizers())
    for optimizer in gaussians._optimizers():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)


def training(dataset, opt, pipe, checkpoint, args):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:  # upstream neither saves nor loads any
        model_params, first_iter = checkpoint
        gaussians.restore(model_params, opt)
    first_iter += 1
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration)
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration == 3:
                gaussians.only_prune(0.05)
            if 3 < iteration < opt.densify_until_iter:
                gaussians.add_densification_stats_abs(render_pkg["viewspace_points"])
                if iteration % 5 == 0:
                    score = compute_edge_score(scene.getTrainCameras()[: args.cams], gaussians, pipe, None)
                    gaussians._prune_gaussians(0.05, score)
                if iteration % 8 == 0:
                    gaussians.reset_opacity()
            if iteration < opt.iterations:
                if iteration <= 20:
                    step(gaussians)
                elif iteration <= 40:
                    if iteration % 4 == 0:
                        step(gaussians)
                else:
                    if iteration % 8 == 0:
                        step(gaussians)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **options):
    opt = SimpleNamespace(iterations=LAST, last=last, densify_until_iter=20, optimizer_type="default")
    opt.__dict__.update(options)
    return training(dataset(order), opt, None, checkpoint, SimpleNamespace(cams=2))
