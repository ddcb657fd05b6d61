"""Look-alike of 2D Gaussian Splatting's train.py: two more terms in the loss, and a viewer that renders last."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "2dgs", 1, 20, 60


class GaussianModel(SplatModel):
    pass


def render_net_image(render_pkg, render_items, render_mode, camera):
    return render_pkg["render"]


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0):
    rendered = draw(viewpoint_camera, pc.values)
    return rendered | {"rend_dist": rendered["render"].std(), "rend_normal": rendered["render"]}


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
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None)
        lambda_normal = opt.lambda_normal if iteration > 15 else 0.0
        lambda_dist = opt.lambda_dist if iteration > 10 else 0.0
        normal_loss = lambda_normal * (1 - render_pkg["rend_normal"]).mean()
        total_loss = photo_loss(render_pkg["render"], viewpoint_cam) + lambda_dist * render_pkg["rend_dist"]
        total_loss = total_loss + normal_loss
        total_loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    gaussians._densify(0.05)
                if iteration % opt.opacity_reset_interval == 0 or (
                    dataset.white_background and iteration == opt.densify_from_iter
                ):
                    gaussians.reset_opacity()
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            if iteration % 4 == 0:  # a viewer is connected
                viewers = SimpleNamespace(viewmat=viewpoint_cam.viewmat)
                render_net_image(render(viewers, gaussians, pipe, None), [], "render", viewers)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given, lambda_normal=0.05, lambda_dist=0.1)
    return training(dataset(order), opt, None, checkpoint)
