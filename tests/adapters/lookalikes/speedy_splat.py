"""Look-alike of Speedy-Splat: prunes by backwards of its own, from the end of densification to the very end."""

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "speedy_splat", 1, 21, 60


class GaussianModel(SplatModel):
    pass


def render(viewpoint_camera, pc, pipe, bg_color, scores=None, scaling_modifier=1.0, override_color=None):
    return draw(viewpoint_camera, pc.values, scores=scores)


def score_func(view, gaussians, pipeline, background, scores):
    img_scores = torch.zeros_like(scores)
    img_scores.requires_grad = True
    image = render(view, gaussians, pipeline, background, scores=img_scores)["render"]
    image.sum().backward()
    scores += img_scores.grad


def prune(scene, gaussians, pipe, background, prune_ratio):
    with torch.enable_grad():
        scores = torch.zeros_like(gaussians.values["opacity"])
        for view in scene.getTrainCameras():
            score_func(view, gaussians, pipe, background, scores)
    gaussians.prune_gaussians(prune_ratio, scores)


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
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    gaussians._densify(0.05)
                if (
                    (iteration >= opt.prune_from_iter)
                    and (iteration < opt.prune_until_iter)
                    and (iteration % opt.prune_interval == 0)
                ):
                    prune(scene, gaussians, pipe, None, 0.2)
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step([gaussians.optimizer])
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
            if (
                (iteration >= opt.densify_until_iter)
                and (iteration >= opt.prune_from_iter)
                and (iteration < opt.prune_until_iter)
                and (iteration % opt.prune_interval == 0)
            ):
                prune(scene, gaussians, pipe, None, 0.1)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given, prune_interval=10, prune_from_iter=6, prune_until_iter=61)
    return training(dataset(order), opt, None, checkpoint)
