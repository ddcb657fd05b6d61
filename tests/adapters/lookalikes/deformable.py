"""Look-alike of Deformable-3D-Gaussians' train.py: a network moves Gaussians with time; rates are set at the end."""

import copy

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "deformable", 1, 20, 60


class GaussianModel(SplatModel):
    def densify_and_prune(self, share):
        self._densify(share)


class DeformModel(torch.nn.Linear):
    def train_setting(self):
        self.optimizer = torch.optim.Adam(self.parameters(), lr=0.001)


def get_linear_noise_func():
    return lambda iteration: 0.1 * 0.9**iteration


def render(viewpoint_camera, pc, pipe, bg_color, d_xyz, is_6dof=False, scaling_modifier=1.0):
    return draw(viewpoint_camera, {**pc.values, "xyz": pc.values["xyz"] + d_xyz})


def training(dataset, opt, pipe, checkpoint=None):
    torch.manual_seed(3)
    deform = DeformModel(4, 3)
    deform.train_setting()
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    if checkpoint:
        model_params, first_iter = checkpoint
        model_params, deform = copy.deepcopy(model_params)
        gaussians.restore(model_params, opt)
    first_iter += 1
    smooth_term = get_linear_noise_func()
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, gaussians.values.values())
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        positions = gaussians.values["xyz"].detach()
        noise = torch.randn(1, generator=torch.Generator().manual_seed(iteration)) * smooth_term(iteration)
        times = (viewpoint_cam.viewmat[0, 3] + noise).expand(len(positions), 1)
        d_xyz = 0.0 if iteration < opt.warm_up else deform(torch.cat([positions, times], dim=1))
        render_pkg = render(viewpoint_cam, gaussians, pipe, None, d_xyz)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration % 10 == 0:  # evaluation
                render(scene.getTrainCameras()[0], gaussians, pipe, None, 0.0)
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    gaussians.densify_and_prune(0.05)
                if iteration % opt.opacity_reset_interval == 0 or (
                    dataset.white_background and iteration == opt.densify_from_iter
                ):
                    gaussians.reset_opacity()
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step([gaussians.optimizer, deform.optimizer])
                gaussians.optimizer.step()
                gaussians.update_learning_rate(iteration)
                deform.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
                deform.optimizer.zero_grad()
    return (gaussians.capture(), deform), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given, warm_up=5)
    return training(dataset(order), opt, None, checkpoint)
