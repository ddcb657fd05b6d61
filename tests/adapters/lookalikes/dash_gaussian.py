"""Look-alike of DashGaussian's train_dash.py: resolution rises while it densifies; exposure has its own optimizer."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

SCRIPT = "train_dash.py"
ADAPTER, FIRST, START, LAST = "dash_gaussian", 1, 20, 60


class TrainingScheduler:
    def __init__(self, opt):
        self.begins, self.level = (0, opt.densify_until_iter // 2, opt.densify_until_iter, float("inf")), 0

    def get_res_scale(self, iteration):
        while iteration >= self.begins[self.level + 1]:
            self.level += 1
        return (2, 1, 1)[self.level]


class GaussianModel(SplatModel):
    def training_setup(self, opt=None):
        super().training_setup(opt)
        self.exposure = torch.nn.Parameter(torch.ones(3, 1, 1))
        self.exposure_optimizer = torch.optim.Adam([self.exposure], lr=0.01)

    def prune_and_densify(self, min_opacity):
        self._densify(min_opacity)
        return 0


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, use_trained_exp=False, render_size=None):
    rendered = draw(viewpoint_camera, pc.values)
    image = rendered["render"] * pc.exposure
    if render_size is not None and image.shape[1:] != render_size:
        image = torch.nn.functional.interpolate(image[None], size=tuple(render_size))[0]
    return rendered | {"render": image.clamp(0, 1)}


def training(dataset, opt, pipe, checkpoint=None):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        model_params, first_iter = checkpoint
        gaussians.restore(model_params, opt)
    scheduler = TrainingScheduler(opt)
    render_scale = scheduler.get_res_scale(first_iter + 1)
    first_iter += 1
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration)
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        gt_image = viewpoint_cam.original_image
        if render_scale > 1:
            gt_image = torch.nn.functional.interpolate(gt_image[None], scale_factor=1 / render_scale)[0]
        render_pkg = render(viewpoint_cam, gaussians, pipe, None, use_trained_exp=True, render_size=gt_image.shape[-2:])
        loss = photo_loss(render_pkg["render"], SimpleNamespace(original_image=gt_image))
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    gaussians.prune_and_densify(0.05)
                    render_scale = scheduler.get_res_scale(iteration)
                if iteration % opt.opacity_reset_interval == 0 or (
                    dataset.white_background and iteration == opt.densify_from_iter
                ):
                    gaussians.reset_opacity()
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                gaussians.exposure_optimizer.step()
                gaussians.exposure_optimizer.zero_grad(set_to_none=True)
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given)
    return training(dataset(order), opt, None, checkpoint)
