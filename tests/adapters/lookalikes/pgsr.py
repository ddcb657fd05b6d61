"""Look-alike of PGSR's train.py: a neighbouring view is rendered with gradients after the view of the iteration."""

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "pgsr", 1, 20, 60


class GaussianModel(SplatModel):
    def get_points_from_depth(self, image):
        return image.mean()

    def get_points_depth_in_depth_map(self, image, points):
        return image.mean() - points


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, app_model=None, return_plane=True):
    return draw(viewpoint_camera, pc.values, training=True if app_model is None else None)


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
        cameras = scene.getTrainCameras()
        viewpoint_cam = pick(cameras, iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None, return_plane=iteration > 5)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        if iteration > opt.multi_view_weight_from_iter:
            nearest_cam = pick(cameras, iteration + 1)
            nearest = render(nearest_cam, gaussians, pipe, None, app_model=True, return_plane=True)
            points = gaussians.get_points_from_depth(render_pkg["render"])
            loss = loss + 0.03 * gaussians.get_points_depth_in_depth_map(nearest["render"], points).abs()
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
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given, multi_view_weight_from_iter=10)
    return training(dataset(order), opt, None, checkpoint)
