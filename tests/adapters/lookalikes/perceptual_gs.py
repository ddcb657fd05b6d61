"""Look-alike of Perceptual-GS's train.py: a term on sensitivities up to the iteration that rebuilds the model."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, photo_loss, pick

ADAPTER, FIRST, START, LAST = "perceptual_gs", 1, 21, 60


class GaussianModel(SplatModel):
    @property
    def get_sensitivity(self):
        return torch.sigmoid(self.values["opacity"])

    def densify_and_prune(self, share):
        self._prune_gaussians(share, self.values["opacity"])

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
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        if iteration <= opt.densify_until_iter:
            shown = render(viewpoint_cam, gaussians, pipe, None, override_color=1 - gaussians.get_sensitivity)
            loss = 0.9 * loss + 0.1 * (1 - shown["render"]).mean()
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration % 5 == 0:
                    gaussians.densify_and_prune(0.05)
                if iteration % 8 == 0:
                    gaussians.reset_opacity()
            if iteration == opt.densify_until_iter:
                gaussians.reinitial_pts()
                gaussians.training_setup(opt)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **options):
    opt = SimpleNamespace(iterations=LAST, last=last, densify_until_iter=20)
    opt.__dict__.update(options)
    return training(dataset(order), opt, None, checkpoint)
