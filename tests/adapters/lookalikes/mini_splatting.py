"""Look-alike of Mini-Splatting's ms/train.py: two simplifications after densification, each with a new optimizer."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

SCRIPT = "ms/train.py"
ADAPTER, FIRST, START, LAST = "mini_splatting", 1, 31, 70


class GaussianModel(SplatModel):
    def densify_and_prune_split(self, share, mask):
        assert len(mask) == len(self.values["xyz"])
        self._densify(share)

    def reinitial_pts(self, count):
        self.values["opacity"] = torch.nn.Parameter(torch.full_like(self.values["opacity"], -1.0))
        log.structure.append((log.now, "rebuilt", len(self.values["xyz"])))


def render_imp(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0):
    return draw(viewpoint_camera, pc.values)


def training(dataset, opt, pipe, checkpoint, args):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        model_params, first_iter = checkpoint
        gaussians.restore(model_params, opt)
    first_iter += 1
    mask_blur = torch.zeros(len(gaussians.values["xyz"]), dtype=torch.bool)
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, gaussians.values.values())
        simp_iteration1 = args.simp_iteration1
        if iteration < simp_iteration1:
            gaussians.update_learning_rate(iteration)
        else:
            gaussians.update_learning_rate(iteration - simp_iteration1 + 10)
        if iteration % 9 == 0 and iteration > simp_iteration1:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render_imp(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                mask_blur = mask_blur | (gaussians.values["scaling"].detach().amax(dim=1) > -0.9)
                if (
                    iteration > opt.densify_from_iter
                    and iteration % opt.densification_interval == 0
                    and iteration % 12 != 0
                    and len(gaussians.values["xyz"]) < args.num_max
                ):
                    gaussians.densify_and_prune_split(0.05, mask_blur)
                    mask_blur = torch.zeros(len(gaussians.values["xyz"]), dtype=torch.bool)
                if iteration % 12 == 0:
                    gaussians.reinitial_pts(args.num_depth)
                    gaussians.training_setup(opt)
                    mask_blur = torch.zeros(len(gaussians.values["xyz"]), dtype=torch.bool)
            if iteration == simp_iteration1:
                render_imp(scene.getTrainCameras()[0], gaussians, pipe, None)
                gaussians._prune_gaussians(0.1, gaussians.values["opacity"])
                gaussians.training_setup(opt)
            if iteration == args.simp_iteration2:
                render_imp(scene.getTrainCameras()[0], gaussians, pipe, None)
                gaussians._prune_gaussians(0.1, gaussians.values["opacity"])
                gaussians.training_setup(opt)
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given)
    args = SimpleNamespace(simp_iteration1=20, simp_iteration2=30, num_max=10**6, num_depth=100)
    return training(dataset(order), opt, None, checkpoint, args)
