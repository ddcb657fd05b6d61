"""Look-alike of Mini-Splatting's ms/train.py: two simplifications after densification, each with a new optimizer."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, photo_loss, pick

SCRIPT = "ms/train.py"
ADAPTER, FIRST, START, LAST = "mini_splatting", 1, 31, 70


class GaussianModel(SplatModel):
    def densify_and_prune_split(self, share):
        self._prune_gaussians(share, self.values["opacity"])

    def reinitial_pts(self):
        self.values["opacity"] = torch.nn.Parameter(torch.full_like(self.values["opacity"], -1.0))


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
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, gaussians.values.values())
        late = iteration >= args.simp_iteration1
        gaussians.update_learning_rate(iteration - 10 if late else iteration)
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render_imp(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration % 5 == 0 and iteration % 10 != 0 and len(gaussians.values["xyz"]) < args.num_max:
                    gaussians.densify_and_prune_split(0.05)
                if iteration % 10 == 0 and args.num_depth:
                    gaussians.reinitial_pts()
                    gaussians.training_setup(opt)
            if iteration == args.simp_iteration1 or iteration == args.simp_iteration2:
                render_imp(scene.getTrainCameras()[0], gaussians, pipe, None)
                gaussians._prune_gaussians(0.1, gaussians.values["opacity"])
                gaussians.training_setup(opt)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **options):
    opt = SimpleNamespace(iterations=LAST, last=last, densify_until_iter=20)
    opt.__dict__.update(options)
    args = SimpleNamespace(simp_iteration1=20, simp_iteration2=30, num_max=10**6, num_depth=100)
    return training(dataset(order), opt, None, checkpoint, args)
