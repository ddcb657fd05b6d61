"""Look-alike of Octree-GS's train.py: anchors on levels, which are shown one after the other."""

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "octree_gs", 1, 26, 66


class GaussianModel(SplatModel):
    def set_coarse_interval(self, coarse_iter, coarse_factor):
        self.coarse_interval = coarse_iter

    def set_anchor_mask(self, iteration):
        self.visibility = len(self.values["xyz"]) * min(1.0, 0.5 + 0.5 * (iteration - 1) / self.coarse_interval)

    def training_statis(self, viewspace_points):
        self.add_densification_stats(viewspace_points)

    def prune_anchor(self, mask):
        self.prune_points(mask)

    def adjust_anchor(self, min_opacity):
        self._use_up()
        self.prune_anchor(self.values["opacity"][:, 0] < self.values["opacity"].quantile(min_opacity))


def prefilter_voxel(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0):
    return torch.arange(len(pc.values["xyz"])) < pc.visibility


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, visible_mask=None, retain_grad=False):
    opacity = torch.where(visible_mask[:, None], pc.values["opacity"], pc.values["opacity"] - 9.0)
    return draw(viewpoint_camera, {**pc.values, "opacity": opacity})


def training(dataset, opt, pipe, checkpoint=None):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    gaussians.set_coarse_interval(opt.coarse_iter, 1.5)
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
        gaussians.set_anchor_mask(iteration)
        mask = prefilter_voxel(viewpoint_cam, gaussians, pipe, None)
        retain_grad = iteration < opt.update_until
        render_pkg = render(viewpoint_cam, gaussians, pipe, None, visible_mask=mask, retain_grad=retain_grad)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.update_until and iteration > opt.start_stat:
                gaussians.training_statis(render_pkg["viewspace_points"])
                if opt.update_anchor and iteration > opt.update_from and iteration % opt.update_interval == 0:
                    gaussians.adjust_anchor(0.05)
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    update = {"update_until": 20, "update_interval": 5, "update_from": 4, "update_anchor": True, "start_stat": 2}
    opt = options(LAST, last, given, coarse_iter=25, **update)
    run = dataset(order)
    run.progressive = True
    for camera in run.cameras:
        camera.resolution_scale = 1.0
    return training(run, opt, None, checkpoint)
