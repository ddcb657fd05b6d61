"""Look-alike of Pixel-GS's train.py: gradients weighted by pixels while it densifies, Inria's loop after."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, photo_loss, pick

ADAPTER, FIRST, START, LAST = "pixel_gs", 1, 20, 60


class GaussianModel(SplatModel):
    def add_densification_stats(self, viewspace_points, pixels):
        self.gradients_read += float((viewspace_points.grad[0].norm(dim=-1) * pixels).sum())


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, depth_threshold=None):
    return draw(viewpoint_camera, pc.values) | {"pixels": torch.ones(len(pc.values["xyz"]))}


def training(dataset, opt, pipe, checkpoint=None):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        model_params, first_iter = checkpoint
        gaussians.restore(model_params, opt)
    first_iter += 1
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration)
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None, depth_threshold=opt.depth_threshold * 2)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"], render_pkg["pixels"])
                if iteration % 5 == 0:
                    gaussians._prune_gaussians(0.05, gaussians.values["opacity"])
                if iteration % 8 == 0:
                    gaussians.reset_opacity()
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **options):
    opt = SimpleNamespace(iterations=LAST, last=last, densify_until_iter=20, depth_threshold=0.4)
    opt.__dict__.update(options)
    return training(dataset(order), opt, None, checkpoint)
