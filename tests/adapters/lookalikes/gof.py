"""Look-alike of GOF's train.py: Mip-Splatting's 3D filter, and terms that join the loss at some iteration."""

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "gof", 1, 20, 60


class GaussianModel(SplatModel):
    def compute_3D_filter(self, cameras):
        depths = torch.stack([self.values["xyz"][:, 2] + camera.viewmat[2, 3] for camera in cameras])
        self.filter_3D = 0.02 * depths.detach().abs().amin(dim=0)[:, None]


def create_offset_gt(image, offset):  # imported and not used upstream
    return image


def render(viewpoint_camera, pc, pipe, bg_color, kernel_size, scaling_modifier=1.0):
    scales = 0.5 * torch.log(torch.exp(2 * pc.values["scaling"]) + pc.filter_3D**2)
    return draw(viewpoint_camera, {**pc.values, "scaling": scales})


def training(dataset, opt, pipe, checkpoint=None):
    first_iter = 0
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    trainCameras = scene.getTrainCameras().copy()
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
        is_save_images = True
        if is_save_images and iteration % opt.densification_interval == 0:
            log.pictures.append(iteration)
        render_pkg = render(viewpoint_cam, gaussians, pipe, None, kernel_size=0.1)
        lambda_distortion = 0.1 if iteration >= opt.distortion_from_iter else 0.0
        lambda_depth_normal = 0.05 if iteration >= opt.depth_normal_from_iter else 0.0
        loss = photo_loss(render_pkg["render"], viewpoint_cam) + lambda_distortion * render_pkg["render"].std()
        loss = loss + lambda_depth_normal * (1 - render_pkg["render"]).mean()
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
    opt = options(LAST, last, given, distortion_from_iter=20, depth_normal_from_iter=20)
    return training(dataset(order), opt, None, checkpoint)
