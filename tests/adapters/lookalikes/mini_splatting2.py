"""Look-alike of Mini-Splatting2's msv2/train.py: Gaussians culled per view, which all return half-way to the end."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

SCRIPT = "msv2/train.py"
ADAPTER, FIRST, START, LAST = "mini_splatting2", 1, 51, 80


class SparseAdam(torch.optim.Adam):
    def step(self, visible, count):
        assert len(visible) == count
        super().step()


class GaussianModel(SplatModel):
    adam = SparseAdam

    def __init__(self):
        super().__init__()
        self.culling = torch.zeros(len(self.values["xyz"]), dtype=torch.bool)

    def init_culling(self, count):
        self.culling = torch.zeros(len(self.values["xyz"]), dtype=torch.bool)
        log.structure.append((log.now, "culling", len(self.culling)))

    def culling_with_interesction_preserving(self):
        self._prune_gaussians(0.1, self.values["opacity"])
        self.culling = self.values["opacity"][:, 0] < self.values["opacity"].median()

    def culling_with_clone(self):
        log.happened.append((log.now, "cloned"))

    def depth_reinit(self):
        return self.values["xyz"].detach()


def render_imp(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, culling=None):
    opacity = torch.where(culling[:, None], pc.values["opacity"] - 5.0, pc.values["opacity"])
    return draw(viewpoint_camera, {**pc.values, "opacity": opacity})


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
        gaussians.update_learning_rate(iteration)
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render_imp(viewpoint_cam, gaussians, pipe, None, culling=gaussians.culling)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if (
                    iteration > opt.densify_from_iter
                    and iteration % opt.densification_interval == 0
                    and iteration != args.depth_reinit_iter
                ):
                    gaussians._densify(0.05)
                    gaussians.init_culling(len(scene.getTrainCameras()))
                if iteration == args.depth_reinit_iter:
                    gaussians.depth_reinit()
                    gaussians.training_setup(opt)
                    gaussians.init_culling(len(scene.getTrainCameras()))
                if (
                    iteration >= args.aggressive_clone_from_iter
                    and iteration % args.aggressive_clone_interval == 0
                    and iteration != args.depth_reinit_iter
                ):
                    gaussians.culling_with_clone()
            if iteration == args.simp_iteration2:
                gaussians.culling_with_interesction_preserving()
            if iteration == (args.simp_iteration2 + opt.iterations) // 2:
                gaussians.init_culling(len(scene.getTrainCameras()))
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                visible = torch.ones(len(gaussians.values["xyz"]), dtype=torch.bool)
                gaussians.optimizer.step(visible, len(visible))
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given, densify_until_iter=19, densification_interval=3)
    args = SimpleNamespace(simp_iteration2=20, depth_reinit_iter=7)
    args.__dict__.update(aggressive_clone_from_iter=4, aggressive_clone_interval=8)
    return training(dataset(order), opt, None, checkpoint, args)
