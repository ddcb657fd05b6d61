"""Look-alike of LightGaussian's train_densify_prune.py: from scratch, with prunes after densification."""

from types import SimpleNamespace

import torch
from lookalikes.lightgaussian_prune_finetune import calculate_v_imp_score, prune_list
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick
from torch.optim.lr_scheduler import ExponentialLR

SCRIPT = "train_densify_prune.py"
ADAPTER, FIRST, START, LAST = "lightgaussian", 1, 20, 60
SETTLED = 46  # after the last prune: refinement begins here if iterations are left out


class GaussianModel(SplatModel):
    adam = torch.optim.AdamW


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, override_color=None):
    return draw(viewpoint_camera, pc.values)


def training(dataset, opt, pipe, checkpoint, args):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    gaussians.scheduler = ExponentialLR(gaussians.optimizer, gamma=0.97)
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
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    gaussians._densify(0.05)
                if iteration % opt.opacity_reset_interval == 0 or (
                    dataset.white_background and iteration == opt.densify_from_iter
                ):
                    gaussians.reset_opacity()
            if iteration in args.prune_iterations:
                i = args.prune_iterations.index(iteration)
                v_list = calculate_v_imp_score(gaussians, prune_list(gaussians, scene, pipe, None), args.v_pow)
                gaussians.prune_gaussians(args.prune_decay**i * args.prune_percent, v_list)
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
    args = SimpleNamespace(prune_iterations=[30, 45], prune_percent=0.3, prune_decay=0.8, v_pow=0.1)
    return training(dataset(order), opt, None, checkpoint, args)
