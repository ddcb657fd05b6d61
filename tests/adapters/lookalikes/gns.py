"""Look-alike of GNS's train.py: Improved-GS, then a selection by opacity with prunes, then rarer steps."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "gns", 1, 31, 72


class GaussianModel(SplatModel):
    def add_densification_stats_abs(self, viewspace_points):
        self.add_densification_stats(viewspace_points)

    def densify_and_prune_Improved(self, share):
        self._densify(share)

    def only_prune(self, share):
        self._prune_gaussians(share, self.values["opacity"])

    def final_prune(self, budget):
        self._prune_gaussians(0.1, self.values["opacity"])

    def update_opacity_lr(self, rate):
        for group in self.optimizer.param_groups:
            group["lr"] *= rate if group["name"] == "opacity" else 1
        log.happened.append((log.now, f"opacity {rate}"))


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, override_color=None, pixel_weights=None):
    return draw(viewpoint_camera, pc.values)


def compute_edge_score(camlist, gaussians, pipe, bg):
    return [render(camera, gaussians, pipe, bg, pixel_weights=camera.original_image) for camera in camlist]


def training(dataset, opt, pipe, checkpoint, args):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        model_params, first_iter = checkpoint
        gaussians.restore(model_params, opt)
    first_iter += 1
    prune_iter = 99999999
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration)
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        if opt.prune_reg and opt.reg_end >= iteration >= opt.reg_start and (iteration - 1) % opt.reg_interval == 0:
            log.happened.append((log.now, "selection"))
            loss += 0.01 * (gaussians.values["opacity"].mean() + 2) ** 2
        loss.backward()
        with torch.no_grad():
            if opt.densify_from_iter < iteration < opt.densify_until_iter:
                gaussians.add_densification_stats_abs(render_pkg["viewspace_points"])
                if iteration % opt.densification_interval == 0:
                    compute_edge_score(scene.getTrainCameras()[: args.cams], gaussians, pipe, None)
                    gaussians.densify_and_prune_Improved(0.05)
                if iteration % opt.opacity_reset_interval == 0 or (
                    dataset.white_background and iteration == opt.densify_from_iter
                ):
                    gaussians.reset_opacity()
            if iteration > opt.reg_start and opt.prune_reg and len(gaussians.values["xyz"]) < opt.final_budget * 1.05:
                gaussians.final_prune(opt.final_budget)
                opt.prune_reg = False
                prune_iter = iteration
            if opt.prune_reg and opt.reg_end > iteration >= opt.reg_start:
                if iteration == opt.reg_start:
                    gaussians.update_opacity_lr(4)
                if iteration % opt.reg_interval == 0:
                    gaussians.only_prune(0.02)
            elif opt.prune_reg and iteration == opt.reg_end:
                gaussians.final_prune(opt.final_budget)
                opt.prune_reg = False
                prune_iter = iteration
            if iteration == prune_iter + 7:
                gaussians.update_opacity_lr(1 / 4)
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations and opt.optimizer_type == "default":
                if iteration <= 24:
                    step(gaussians)
                elif iteration <= 40:
                    if iteration % 4 == 0:
                        step(gaussians)
                else:
                    if iteration % 8 == 0:
                        step(gaussians)
    return gaussians.capture(), iteration


def step(gaussians):
    note_step(gaussians._optimizers())
    gaussians.optimizer.step()
    gaussians.optimizer.zero_grad(set_to_none=True)


def train(checkpoint=None, last=LAST, order=0, **given):
    selection = {"prune_reg": True, "reg_start": 20, "reg_end": 30, "reg_interval": 3, "final_budget": 10}
    opt = options(LAST, last, given, optimizer_type="default", **selection)
    return training(dataset(order), opt, None, checkpoint, SimpleNamespace(cams=2))
