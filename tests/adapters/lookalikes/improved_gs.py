"""Look-alike of Improved-GS's train.py: edge scores while it densifies, then steps every 4th and 8th iteration."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

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
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration == 3:
                gaussians.only_prune(0.05)
            if opt.densify_from_iter < iteration < opt.densify_until_iter:
                gaussians.add_densification_stats_abs(render_pkg["viewspace_points"])
                if iteration % opt.densification_interval == 0:
                    score = compute_edge_score(scene.getTrainCameras()[: args.cams], gaussians, pipe, None)
                    gaussians._densify(0.05, score)
                if iteration % opt.opacity_reset_interval == 0 or (
                    dataset.white_background and iteration == opt.densify_from_iter
                ):
                    gaussians.reset_opacity()
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations and opt.optimizer_type == "default":
                if iteration <= 20:
                    step(gaussians)
                elif iteration <= 40:
                    if iteration % 4 == 0:
                        step(gaussians)
                else:
                    if iteration % 8 == 0:
                        step(gaussians)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given, optimizer_type="default")
    return training(dataset(order), opt, None, checkpoint, SimpleNamespace(cams=2))
