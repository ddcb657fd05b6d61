"""Look-alike of LightGaussian's distill_train.py: a student learns from a teacher, from jittered cameras too."""

import copy
from types import SimpleNamespace

import torch
from lookalikes.lightgaussian_prune_finetune import calculate_v_imp_score, prune_list  # noqa: F401
from lookalikes.splats import NAMES, Scene, SplatModel, dataset, draw, log, note_step, options, pick
from torch.optim.lr_scheduler import ExponentialLR

SCRIPT = "distill_train.py"
ADAPTER, FIRST, START, LAST = "lightgaussian", 31, 31, 80
VIEWS = NAMES + [f"{name}/jittered" for name in NAMES]


class GaussianModel(SplatModel):
    adam = torch.optim.AdamW


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, override_color=None):
    return draw(viewpoint_camera, pc.values)


def gaussian_poses(viewpoint_cam, mean, std_dev_translation):
    viewpoint_cam.viewmat[:3, 3] += mean + std_dev_translation * torch.randn(3)
    return viewpoint_cam


def training(args, dataset, opt, pipe, checkpoint):
    first_iter = 30
    teacher_gaussians = GaussianModel()
    teacher_gaussians.restore({}, copy.deepcopy(opt))
    student_gaussians = GaussianModel()
    student_scene = Scene(dataset, student_gaussians)
    student_gaussians.training_setup(opt)
    student_gaussians.scheduler = ExponentialLR(student_gaussians.optimizer, gamma=0.90)
    student_gaussians.values["f_dc"].data.mul_(0.5)  # as if fewer SH coefficients were left
    if checkpoint:
        model_params, first_iter = checkpoint
        student_gaussians.restore(model_params, opt)
    first_iter += 1
    for iteration in range(first_iter, opt.last + 1):
        log.begins(iteration, student_gaussians.values.values())
        torch.manual_seed(iteration)
        student_gaussians.update_learning_rate(iteration)
        viewpoint_cam = copy.deepcopy(pick(student_scene.getTrainCameras(), iteration))
        if args.augmented_view and iteration % 3:
            viewpoint_cam = gaussian_poses(viewpoint_cam, mean=0, std_dev_translation=0.05)
        student_image = render(viewpoint_cam, student_gaussians, pipe, None)["render"]
        teacher_image = render(viewpoint_cam, teacher_gaussians, pipe, None)["render"].detach()
        loss = (student_image - teacher_image).abs().mean()
        loss.backward()
        with torch.no_grad():
            if iteration in opt.saving_iterations:
                student_scene.save(iteration)
            if iteration < opt.iterations:
                note_step([student_gaussians.optimizer])
                student_gaussians.optimizer.step()
                student_gaussians.optimizer.zero_grad(set_to_none=True)
        if iteration % 20 == 0:
            student_gaussians.scheduler.step()
    return student_gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, augmented_view=True, **given):
    opt = options(LAST, last, given)
    return training(SimpleNamespace(augmented_view=augmented_view), dataset(order), opt, None, checkpoint)
