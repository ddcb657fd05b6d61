"""Look-alike of FastGS: two optimizers that step every 8th iteration after densification, and late prunes."""

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, note_step, options, photo_loss, pick

ADAPTER, FIRST, START, LAST = "fastgs", 1, 20, 64
PRUNES, STEP_EVERY = (32, 44), 8


class GaussianModel(SplatModel):
    def training_setup(self, opt=None):
        self.optimizer = self.adam([self.group(name) for name in self.rates if name != "f_rest"], eps=1e-15)
        self.shoptimizer = self.adam([self.group("f_rest")], eps=1e-15)

    def _optimizers(self):
        return [self.optimizer, self.shoptimizer]

    def optimizer_step(self, iteration):
        """As upstream: gradients stay until the step that uses them."""
        due = [self.optimizer] * (iteration <= 20 or iteration % STEP_EVERY == 0)
        due += [self.shoptimizer] * (iteration % STEP_EVERY == 0)
        note_step(due)
        for optimizer in due:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    def final_prune_fastgs(self, min_opacity, pruning_score=None):
        self._prune_gaussians(0.2, pruning_score)


def render_fastgs(viewpoint_camera, pc, pipe, bg_color, mult, get_flag=None, metric_map=None):
    return draw(viewpoint_camera, pc.values)


def compute_gaussian_score_fastgs(camlist, gaussians, pipe, bg, opt):
    for camera in camlist:
        render_fastgs(camera, gaussians, pipe, bg, opt.mult)
        render_fastgs(camera, gaussians, pipe, bg, opt.mult, get_flag=True)
    return gaussians.values["opacity"].clone()


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
        if iteration % 9 == 0:
            gaussians.oneupSHdegree()
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        render_pkg = render_fastgs(viewpoint_cam, gaussians, pipe, None, opt.mult)
        loss = photo_loss(render_pkg["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter:
                gaussians.add_densification_stats(render_pkg["viewspace_points"])
                if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
                    score = compute_gaussian_score_fastgs(scene.getTrainCameras()[:2], gaussians, pipe, None, opt)
                    gaussians._densify(0.05, score)
            if iteration in PRUNES:
                score = compute_gaussian_score_fastgs(scene.getTrainCameras(), gaussians, pipe, None, opt)
                gaussians.final_prune_fastgs(min_opacity=0.1, pruning_score=score)
            if iteration in opt.saving_iterations:
                scene.save(iteration)
            if iteration < opt.iterations:
                gaussians.optimizer_step(iteration)
    return gaussians.capture(), iteration


def train(checkpoint=None, last=LAST, order=0, **given):
    opt = options(LAST, last, given, mult=0.5)
    return training(dataset(order), opt, None, checkpoint)
