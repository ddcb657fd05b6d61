"""Look-alike of Taming 3DGS: opacity frozen when densification ends, SH stepped every 8th iteration."""

from types import SimpleNamespace

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "taming", 1, 20, 64
STEP_EVERY = 8


class GaussianModel(SplatModel):
    def training_setup(self, opt=None):
        self.optimizer = self.adam([self.group(name) for name in self.rates if name != "f_rest"], eps=1e-15)
        self.shoptimizer = self.adam([self.group("f_rest")], eps=1e-15)

    def _optimizers(self):
        return [self.optimizer, self.shoptimizer]

    def modify_functions(self):
        opacity = torch.sigmoid(self.values["opacity"].detach()).abs()  # renders the same, and no optimizer has it
        opacity.frozen = True
        self.values["opacity"] = opacity
        log.structure.append((log.now, "frozen", len(opacity)))


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, override_color=None, pixel_weights=None):
    return draw(viewpoint_camera, pc.values)


def compute_gaussian_score(scene, camlist, gaussians, pipe, bg):
    with torch.no_grad():
        for camera in camlist:
            render(camera, gaussians, pipe, bg)
            render(camera, gaussians, pipe, bg, pixel_weights=camera.original_image)
    return gaussians.values["opacity"].detach()


def get_count_array(start_count, budget, opt, mode):
    return [start_count]


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
        render_pkg = render(viewpoint_cam, gaussians, pipe, None)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    score = compute_gaussian_score(scene, scene.getTrainCameras()[:2], gaussians, pipe, None)
                    gaussians._densify(0.05, score)
            if iteration == args.ho_iteration:
                gaussians.modify_functions()
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                due = [gaussians.optimizer]
                if args.sh_lower:
                    if iteration % STEP_EVERY == 0:
                        due.append(gaussians.shoptimizer)
                else:
                    due.append(gaussians.shoptimizer)
                note_step(due)
                for optimizer in due:
                    optimizer.step()
                    optimizer.zero_grad(set_to_none=True)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, sh_lower=False, **given):
    opt = options(LAST, last, given)
    args = SimpleNamespace(ho_iteration=20, sh_lower=sh_lower)
    return training(dataset(order), opt, None, checkpoint, args)
