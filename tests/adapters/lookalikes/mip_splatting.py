"""Look-alike of Mip-Splatting's train.py: a 3D filter that is computed anew after densification too."""

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "mip_splatting", 1, 20, 60


class GaussianModel(SplatModel):
    def compute_3D_filter(self, cameras):
        depths = torch.stack([self.values["xyz"][:, 2] + camera.viewmat[2, 3] for camera in cameras])
        self.filter_3D = 0.02 * depths.detach().abs().amin(dim=0)[:, None]

    @property
    def _with_3D_filter(self):
        scales = torch.exp(2 * self.values["scaling"]) + self.filter_3D**2
        return {**self.values, "scaling": 0.5 * torch.log(scales)}


def create_offset_gt(image, offset):
    return image


def render(viewpoint_camera, pc, pipe, bg_color, kernel_size, scaling_modifier=1.0, subpixel_offset=None):
    return draw(viewpoint_camera, pc._with_3D_filter)


def training(dataset, opt, pipe, checkpoint=None):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    trainCameras = scene.getTrainCameras().copy()
    # Upstream does this after a checkpoint is loaded, and so no resumed run equals an uninterrupted one.
    gaussians.compute_3D_filter(cameras=trainCameras)
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
        render_pkg = render(viewpoint_cam, gaussians, pipe, None, kernel_size=0.1, subpixel_offset=None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    gaussians._densify(0.05)
                    gaussians.compute_3D_filter(cameras=trainCameras)
            if iteration % 8 == 0 and iteration > opt.densify_until_iter:
                if iteration < opt.iterations - 8:
                    gaussians.compute_3D_filter(cameras=trainCameras)
                    log.structure.append((log.now, "filter", len(gaussians.values["xyz"])))
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                note_step(gaussians._optimizers())
                gaussians.optimizer.step()
                gaussians.optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given)
    return training(dataset(order), opt, None, checkpoint)
