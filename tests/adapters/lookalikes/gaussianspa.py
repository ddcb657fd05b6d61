"""Look-alike of GaussianSpa's train_imp_score.py: restart, ADMM terms on some iterations, prune, fine-tuning."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

SCRIPT = "train_imp_score.py"
ADAPTER, FIRST, START, LAST = "gaussianspa", 1, 41, 80


class GaussianModel(SplatModel):
    def update_learning_rate(self, iteration, training_args):
        super().update_learning_rate(iteration)

    def densify_and_prune_split(self, share):
        self._densify(share)

    def reinitial_pts(self):
        self.values["opacity"] = torch.nn.Parameter(torch.full_like(self.values["opacity"], -2.0))


class OptimizingSpa:
    def __init__(self, gaussians):
        self.opacity = gaussians.values["opacity"]
        self.z = torch.zeros_like(self.opacity)

    def append_spa_loss(self, loss):
        log.happened.append((log.now, "ADMM"))
        loss += 5.0 * (torch.sigmoid(self.opacity) - self.z).square().mean()
        return loss


def render_imp(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, override_color=None):
    return draw(viewpoint_camera, pc.values)


def update_imp_score(scene, gaussians, pipe):
    with torch.no_grad():
        for camera in scene.getTrainCameras():
            render_imp(camera, gaussians, pipe, None)
    return gaussians.values["opacity"].detach()


def training(dataset, opt, pipe, checkpoint, args):
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
        simp_iteration1 = args.simp_iteration1
        restarted = iteration >= simp_iteration1
        gaussians.update_learning_rate(iteration - 10 if restarted else iteration, opt)
        if iteration % 9 == 0 and iteration > simp_iteration1:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render_imp(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        if (
            opt.optimizing_spa
            and iteration > opt.optimizing_spa_start_iter
            and iteration % opt.optimizing_spa_interval == 0
            and iteration < opt.optimizing_spa_stop_iter
        ):
            loss = optimizing_spa.append_spa_loss(loss)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if (
                    iteration > opt.densify_from_iter
                    and iteration % opt.densification_interval == 0
                    and iteration % 50 != 0
                    and len(gaussians.values["xyz"]) < args.num_max
                ):
                    gaussians.densify_and_prune_split(0.05)
            if iteration == opt.optimizing_spa_start_iter and opt.optimizing_spa:
                optimizing_spa = OptimizingSpa(gaussians)
            elif iteration % opt.optimizing_spa_interval == 0 and opt.optimizing_spa:
                if opt.optimizing_spa_start_iter < iteration <= opt.optimizing_spa_stop_iter:
                    optimizing_spa.z = update_imp_score(scene, gaussians, pipe).clamp(min=0)
            if iteration == simp_iteration1:
                gaussians._prune_gaussians(0.3, update_imp_score(scene, gaussians, pipe))
                gaussians.reinitial_pts()
                gaussians.training_setup(opt)
            if iteration == opt.optimizing_spa_stop_iter:
                gaussians._prune_gaussians(0.4, update_imp_score(scene, gaussians, pipe))
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step([gaussians.optimizer])
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    spa = {"optimizing_spa": True, "optimizing_spa_interval": 5}
    spa.update(optimizing_spa_start_iter=20, optimizing_spa_stop_iter=40)
    opt = options(LAST, last, given, densify_until_iter=15, **spa)
    return training(dataset(order), opt, None, checkpoint, SimpleNamespace(simp_iteration1=15, num_max=10**6))
