"""Look-alike of GaussianSpa's train_op.py: classic render, and a prune after the last ADMM iteration's step."""

import torch
from lookalikes.gaussianspa import OptimizingSpa
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

SCRIPT = "train_op.py"
ADAPTER, FIRST, START, LAST = "gaussianspa", 1, 41, 80


class GaussianModel(SplatModel):
    def update_learning_rate(self, iteration, training_args):
        super().update_learning_rate(iteration)


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, override_color=None):
    return draw(viewpoint_camera, pc.values)


def training(dataset, opt, pipe, checkpoint=None):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    optimizing_spa = None
    if checkpoint:
        model_params, first_iter = checkpoint
        gaussians.restore(model_params, opt)
    first_iter += 1
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration, opt)
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        in_phase = opt.optimizing_spa_start_iter < iteration <= opt.optimizing_spa_stop_iter
        if in_phase and iteration % opt.optimizing_spa_interval == 0:
            loss = optimizing_spa.append_spa_loss(loss)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    gaussians._densify(0.05)
                if iteration % opt.opacity_reset_interval == 0 or (
                    dataset.white_background and iteration == opt.densify_from_iter
                ):
                    gaussians.reset_opacity()
            elif iteration == opt.optimizing_spa_start_iter:
                optimizing_spa = OptimizingSpa(gaussians)
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step([gaussians.optimizer])
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
            if iteration == opt.optimizing_spa_stop_iter:
                gaussians._prune_gaussians(0.4, gaussians.values["opacity"].detach())
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    spa = {"optimizing_spa_interval": 5, "optimizing_spa_start_iter": 20, "optimizing_spa_stop_iter": 40}
    opt = options(LAST, last, given, densify_until_iter=15, **spa)
    return training(dataset(order), opt, None, checkpoint)
