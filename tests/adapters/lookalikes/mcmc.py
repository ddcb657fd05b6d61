"""Look-alike of 3dgs-mcmc's train.py: relocation until densification ends, position noise in every iteration."""

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "mcmc", 1, 20, 60


def build_scaling_rotation(s, r):
    return torch.diag_embed(s)


class GaussianModel(SplatModel):
    def update_learning_rate(self, iteration, opt=None):
        super().update_learning_rate(iteration, opt)
        return self.optimizer.param_groups[0]["lr"]

    @property
    def _covariance(self):
        """As upstream, the model calls the loop's function too."""
        return build_scaling_rotation(torch.exp(self.values["scaling"]), self.values["rotation"])

    def relocate_gs(self, dead_mask):
        self._use_up()
        with torch.no_grad():
            self.values["xyz"][dead_mask] = self.values["xyz"][~dead_mask][0]
        log.structure.append((log.now, "relocate", len(dead_mask)))


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0):
    assert pc._covariance.any()  # also in an iteration whose noise is left out
    return draw(viewpoint_camera, pc.values)


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
        xyz_lr = gaussians.update_learning_rate(iteration)
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        loss = photo_loss(render(viewpoint_cam, gaussians, pipe, None)["render"], viewpoint_cam)
        loss = loss + 0.01 * torch.sigmoid(gaussians.values["opacity"]).mean()
        loss.backward()
        with torch.no_grad():
            if (
                iteration < opt.densify_until_iter
                and iteration > opt.densify_from_iter
                and iteration % opt.densification_interval == 0
            ):
                gaussians.relocate_gs(dead_mask=gaussians.values["opacity"][:, 0] < 0.2)
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
                L = build_scaling_rotation(torch.exp(gaussians.values["scaling"]), gaussians.values["rotation"])
                rng = torch.Generator().manual_seed(iteration)  # the same in a resumed run
                noise = torch.randn(L.shape[:2], generator=rng) * xyz_lr
                gaussians.values["xyz"].add_(torch.bmm(L @ L.transpose(1, 2), noise[..., None])[..., 0])
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given)
    return training(dataset(order), opt, None, checkpoint)
