"""Look-alike of Inria's train.py (classic and current share all of this)."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick
from tqdm import tqdm

ADAPTER, FIRST, START, LAST = "inria", 1, 20, 60


class GaussianModel(SplatModel):
    def densify_and_prune(self, share):
        self._densify(share)


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0):
    return draw(viewpoint_camera, pc.values, training=hasattr(viewpoint_camera, "image_name"))


def training(dataset, opt, pipe, checkpoint=None):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        model_params, first_iter = checkpoint
        gaussians.restore(model_params, opt)
    progress_bar = tqdm(range(first_iter, opt.last), disable=None)
    first_iter += 1
    for iteration in range(first_iter, opt.last + 1):
        if iteration % 4 == 0:  # a viewer is connected
            viewers = scene.getTrainCameras()[0]
            render(SimpleNamespace(viewmat=viewers.viewmat), gaussians, pipe, None)
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration)
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            loss.item()
            if iteration % 10 == 0:  # progress bar
                progress_bar.update(10)
            if iteration == opt.last:
                progress_bar.close()
            if iteration % 10 == 0:  # evaluation
                render(scene.getTrainCameras()[1], gaussians, pipe, None)
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    gaussians.densify_and_prune(0.05)
                if iteration % opt.opacity_reset_interval == 0 or (
                    dataset.white_background and iteration == opt.densify_from_iter
                ):
                    gaussians.reset_opacity()
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step([gaussians.optimizer])
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    """Run like the script, with the settings that a command line gives."""
    opt = options(LAST, last, given)
    return training(dataset(order), opt, None, checkpoint)
