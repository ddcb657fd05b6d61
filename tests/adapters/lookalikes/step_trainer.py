"""Look-alike of the pip package gaussian-splatting: trainers wrapped around each other, inclusive bounds."""

from typing import NamedTuple

import torch
from lookalikes.splats import SplatModel, draw, log, make_cameras, note_step, photo_loss, pick

ADAPTER, FIRST, START, LAST = "step_trainer", 1, 21, 60


class Camera(NamedTuple):
    ground_truth_image_path: str
    view: object


class AbstractTrainer:
    def update_learning_rate(self):
        self.curr_step += 1
        log.begins(self.curr_step, self.model.values.values())

    def preprocess(self, camera):
        return camera

    def optim_step(self):
        note_step([self.optimizer])
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def step(self, camera):
        self.update_learning_rate()
        camera = self.preprocess(camera)
        out = draw(camera.view, self.model.values)
        loss = self.loss(out, camera)
        loss.backward()
        self.before_optim_hook(loss=loss, out=out, camera=camera)
        self.optim_step()
        self.after_optim_hook(loss=loss, out=out, camera=camera)
        return loss, out

    def before_optim_hook(self, loss, out, camera):
        pass

    def after_optim_hook(self, loss, out, camera):
        pass


class DensificationTrainer(AbstractTrainer):
    def __init__(self):
        self.model = SplatModel()
        self.model.training_setup()
        self.optimizer = self.model.optimizer
        self.densifier = Pruner(Densifier())
        self.curr_step = 0

    def loss(self, out, camera):
        return photo_loss(out["render"], camera.view)

    def before_optim_hook(self, loss, out, camera):
        with torch.no_grad():
            self.densifier.densify_and_prune(self.model, out, self.curr_step)


class Densifier:
    def __init__(self):
        self.densify_from_iter, self.densify_until_iter, self.densify_interval = 4, 15, 3

    def densify_and_prune(self, model, out, step):
        if step <= self.densify_until_iter:
            model.add_densification_stats(out["viewspace_points"])
        if self.densify_from_iter <= step <= self.densify_until_iter and step % self.densify_interval == 0:
            model._densify(0.02)


class Pruner:
    def __init__(self, base_densifier):
        self.base_densifier = base_densifier
        self.prune_from_iter, self.prune_until_iter, self.prune_interval = 5, 20, 5

    def densify_and_prune(self, model, out, step):
        self.base_densifier.densify_and_prune(model, out, step)
        if self.prune_from_iter <= step <= self.prune_until_iter and step % self.prune_interval == 0:
            model.prune_gaussians(0.05, model.values["opacity"])


class TrainerWrapper(AbstractTrainer):
    def __init__(self, base_trainer):
        self.base_trainer = base_trainer

    curr_step = property(lambda self: self.base_trainer.curr_step)
    model = property(lambda self: self.base_trainer.model)
    optimizer = property(lambda self: self.base_trainer.optimizer)

    def update_learning_rate(self):
        return self.base_trainer.update_learning_rate()

    def preprocess(self, camera):
        return self.base_trainer.preprocess(camera)

    def loss(self, out, camera):
        return self.base_trainer.loss(out, camera)

    def optim_step(self):
        return self.base_trainer.optim_step()

    def before_optim_hook(self, loss, out, camera):
        return self.base_trainer.before_optim_hook(loss=loss, out=out, camera=camera)


class OpacityResetter(TrainerWrapper):
    def __init__(self, base_trainer):
        super().__init__(base_trainer)
        self.opacity_reset_from_iter, self.opacity_reset_until_iter, self.opacity_reset_interval = 10, 20, 10

    def optim_step(self):
        resets = self.opacity_reset_from_iter <= self.curr_step <= self.opacity_reset_until_iter
        if resets and self.curr_step % self.opacity_reset_interval == 0:
            with torch.no_grad():
                self.model.reset_opacity()
            group = next(group for group in self.optimizer.param_groups if group["name"] == "opacity")
            group["params"][0] = self.model.values["opacity"] = torch.nn.Parameter(self.model.values["opacity"].data)
        return super().optim_step()


class SHLifter(TrainerWrapper):
    raised = 0
    sh_degree_up_interval = 10

    def loss(self, out, camera):
        self.raised += self.curr_step % self.sh_degree_up_interval == 0
        return super().loss(out, camera)


def training(trainer, dataset, iteration):
    for step in range(trainer.curr_step + 1, iteration + 1):
        loss, out = trainer.step(pick_camera(dataset, step))
        loss.item()
        del loss, out


def pick_camera(dataset, step):
    camera = pick(dataset, step)
    return Camera(camera.image_name, camera)


def make():
    return SHLifter(OpacityResetter(DensificationTrainer()))


def dataset():
    return make_cameras()
