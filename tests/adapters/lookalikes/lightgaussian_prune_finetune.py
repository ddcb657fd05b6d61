"""Look-alike of LightGaussian's prune_finetune.py: goes on from a trained model, prunes in its first iteration."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick
from torch.optim.lr_scheduler import ExponentialLR

SCRIPT = "prune_finetune.py"
ADAPTER, FIRST, START, LAST = "lightgaussian", 31, 32, 80


class GaussianModel(SplatModel):
    adam = torch.optim.AdamW


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, override_color=None):
    return draw(viewpoint_camera, pc.values)


def prune_list(gaussians, scene, pipe, background):
    with torch.no_grad():
        for camera in scene.getTrainCameras():
            draw(camera, gaussians.values)
    return gaussians.values["opacity"].detach()


def calculate_v_imp_score(gaussians, imp_list, v_pow):
    return imp_list * gaussians.values["scaling"].detach().sum(1, keepdim=True).exp() ** v_pow


def training(dataset, opt, pipe, checkpoint, args):
    first_iter = 30  # of the model that was trained before
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    gaussians.scheduler = ExponentialLR(gaussians.optimizer, gamma=0.95)
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
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration in args.prune_iterations:
                v_list = calculate_v_imp_score(gaussians, prune_list(gaussians, scene, pipe, None), args.v_pow)
                gaussians.prune_gaussians(args.prune_percent, v_list)
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step([gaussians.optimizer])
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
        if iteration % 20 == 0:
            gaussians.scheduler.step()
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given)
    args = SimpleNamespace(start_pointcloud=None, prune_iterations=[31], prune_percent=0.5, v_pow=0.1)
    return training(dataset(order), opt, None, checkpoint, args)
