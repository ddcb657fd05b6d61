"""Look-alike of Perceptual-GS's train.py: a term on sensitivities up to the iteration that rebuilds the model."""

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "perceptual_gs", 1, 21, 60


class GaussianModel(SplatModel):
    @property
    def get_sensitivity(self):
        return torch.sigmoid(self.values["opacity"])

    def densify_and_prune(self, share):
        self._densify(share)

    def reinitial_pts(self):
        self.values["opacity"] = torch.nn.Parameter(torch.full_like(self.values["opacity"], -1.0))
        log.structure.append((log.now, "rebuilt", len(self.values["xyz"])))


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, override_color=None):
    return draw(viewpoint_camera, pc.values, training=True if override_color is None else None)


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
        if iteration <= opt.densify_until_iter:
            shown = render(viewpoint_cam, gaussians, pipe, None, override_color=1 - gaussians.get_sensitivity)
            loss = 0.9 * loss + 0.1 * (1 - shown["render"]).mean()
        try:
            gt_alpha = viewpoint_cam.alpha.clone()
        except AttributeError:
            gt_alpha = None
        loss.backward()
        if iteration <= opt.densify_until_iter and iteration % opt.hd_interval == 0:
            with torch.no_grad():
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
            log.happened.append((log.now, "weights"))
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    gaussians.densify_and_prune(0.05)
                if iteration % opt.opacity_reset_interval == 0 or (
                    dataset.white_background and iteration == opt.densify_from_iter
                ):
                    gaussians.reset_opacity()
            if iteration == opt.densify_until_iter:
                gaussians.reinitial_pts()
                gaussians.training_setup(opt)
            if gt_alpha is not None and iteration > 3 and iteration % 5 == 0:
                gaussians.prune_points(gaussians.values["opacity"][:, 0] < gaussians.values["opacity"].quantile(0.02))
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given, hd_interval=15)
    return training(dataset(order), opt, None, checkpoint)
