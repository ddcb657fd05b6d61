"""Look-alike of AbsGS's train.py: opacities reduced while it densifies, prunes by blend weight long after."""

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "absgs", 1, 20, 60


class GaussianModel(SplatModel):
    def __init__(self):
        super().__init__()
        self.max_weight = torch.zeros(len(self.values["xyz"]))

    def prune_points(self, mask):
        super().prune_points(mask)
        self.max_weight = self.max_weight[~mask]

    def reduce_opacity(self):
        with torch.no_grad():
            self.values["opacity"].clamp_(max=1.0)
        log.happened.append((log.now, "reduced"))


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0):
    rendered = draw(viewpoint_camera, pc.values)
    return rendered | {"gs_w": torch.sigmoid(pc.values["opacity"].detach()[:, 0])}


def training(dataset, opt, pipe, checkpoint=None):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        model_params, first_iter = checkpoint
        gaussians.restore(model_params, opt)
    first_iter += 1
    viewpoint_stack = None
    img_num = -1
    img_num_modifier = 1
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration)
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        if not viewpoint_stack:
            viewpoint_stack = scene.getTrainCameras().copy()
            if img_num == -1:
                img_num = len(viewpoint_stack)
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            gaussians.max_weight = torch.maximum(gaussians.max_weight, render_pkg["gs_w"])
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    gaussians._densify(0.05)
                if iteration % opt.opacity_reduce_interval == 0 and opt.use_reduce:
                    gaussians.reduce_opacity()
                if iteration % opt.opacity_reset_interval == 0 or (
                    dataset.white_background and iteration == opt.densify_from_iter
                ):
                    gaussians.reset_opacity()
            if iteration > opt.densify_from_iter and iteration < opt.prune_until_iter and opt.use_prune_weight:
                if (
                    iteration % img_num / img_num_modifier == 0
                    and iteration % opt.opacity_reset_interval > img_num / img_num_modifier
                ):
                    gaussians.prune_points(gaussians.max_weight < gaussians.max_weight.quantile(0.1))
                    gaussians.max_weight *= 0
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    own = {"opacity_reduce_interval": 4, "use_reduce": True, "prune_until_iter": 50, "use_prune_weight": False}
    opt = options(LAST, last, given, **own)
    return training(dataset(order), opt, None, checkpoint)
