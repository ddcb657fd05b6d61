"""Look-alike of Faster-GS's trainer in NeRFICG: callbacks by number around a training iteration, MCMC's noise."""

from types import SimpleNamespace

import torch
from lookalikes.splats import SplatModel, draw, log, make_cameras, note_step, photo_loss, pick

ADAPTER, FIRST, START, LAST = "faster_gs", 0, 20, 59


def training_callback(start_iteration=None, end_iteration=None):
    """Wrap a function like NeRFICG: the registered object does not tell which function it wraps."""

    def decorator(function):
        def wrapper(*args, **kwargs):
            return function(*args, **kwargs)

        wrapper.callback_type, wrapper.active, wrapper.__name__ = 0, True, function.__name__
        wrapper.start_iteration, wrapper.end_iteration = start_iteration, end_iteration
        return wrapper

    return decorator


class Gaussians(SplatModel):
    def adaptive_density_control(self):
        self.prune_gaussians(0.05, self.values["opacity"])

    def importance_pruning(self):
        self.prune_gaussians(0.1, self.values["opacity"])

    def post_optimizer_step(self, inject_noise):
        if inject_noise:
            self.values["xyz"].data += 0.001


class Renderer:
    def __init__(self, gaussians):
        self.gaussians = gaussians

    def render_image_training(self, view, update_densification_info, bg_color):
        return draw(view.camera, self.gaussians.values)

    def compute_pruning_scores(self, view):
        self.render_image_training(view=view, update_densification_info=False, bg_color=None)


class FasterGSTrainer:
    def __init__(self, mcmc=False):
        self.DENSIFICATION_END_ITERATION, self.NUM_ITERATIONS, self.USE_MCMC = 19, LAST + 1, mcmc
        self.model = SimpleNamespace(gaussians=Gaussians(), num_iterations_trained=0)
        self.model.gaussians.training_setup()
        self.renderer = Renderer(self.model.gaussians)
        self.output_directory = "results"
        self.views = [SimpleNamespace(camera=camera) for camera in make_cameras()]
        for number, view in enumerate(sorted(self.views, key=lambda view: view.camera.image_name)):
            view.global_frame_idx = number

    @training_callback(start_iteration=5, end_iteration="DENSIFICATION_END_ITERATION")
    def densify(self, iteration):
        self.model.gaussians.adaptive_density_control()

    @training_callback(start_iteration=30)
    def hard_pruning(self, iteration):
        self.renderer.compute_pruning_scores(self.views[0])
        self.model.gaussians.importance_pruning()

    @training_callback()
    def training_iteration(self, iteration, dataset):
        gaussians = self.model.gaussians
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration + 1)
        camera = pick([view.camera for view in self.views], iteration)
        view = next(view for view in self.views if view.camera is camera)
        early = iteration < self.DENSIFICATION_END_ITERATION
        rendered = self.renderer.render_image_training(view=view, update_densification_info=early, bg_color=None)
        loss = photo_loss(rendered["render"], camera)
        loss.backward()
        if early and not self.USE_MCMC:
            float(rendered["viewspace_points"].grad.norm())  # its rasterizer gathers them: fails without a backward
        note_step([gaussians.optimizer])
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()
        gaussians.post_optimizer_step(inject_noise=self.USE_MCMC)

    def run(self, dataset, last=LAST):
        for iteration in range(self.model.num_iterations_trained, last + 1):
            if 5 <= iteration <= self.DENSIFICATION_END_ITERATION and (iteration - 5) % 7 == 0:
                self.densify(iteration)
            self.training_iteration(iteration, dataset)
            if iteration in (30, 45):
                with torch.no_grad():
                    self.hard_pruning(iteration)
            self.model.num_iterations_trained += 1
        return self
