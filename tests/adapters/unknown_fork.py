"""A fork of Inria's script that no adapter knows, with parts that tests choose."""

import types

import torch
from lookalikes.splats import Scene, SplatModel, dataset, draw, log, new_log, photo_loss, pick

TRAIN = """
def training(dataset, opt, pipe):
    gaussians = GaussianModel()
    scene = Scene(dataset, gaussians)
    gaussians.training_setup(opt)
    {before}
    for iteration in range(1, opt.iterations + 1):
        log.begins(iteration, gaussians.values.values())
        gaussians.update_learning_rate(iteration)
        viewpoint_cam = pick(scene.getTrainCameras(), iteration)
        loss = photo_loss(render(viewpoint_cam, gaussians{argument})["render"], viewpoint_cam)
        loss.backward()
        with torch.no_grad():
            if iteration < opt.densify_until_iter: pass
            gaussians.optimizer.step()
            gaussians.optimizer.zero_grad(set_to_none=True)
            {extra}
    {after}
"""


INNER = "def inner(loss):\n        loss.backward()"
HELPERS = """
def set_rates(gaussians, number):
    gaussians.update_learning_rate(number)

def optimise(loss):
    loss.backward()
"""


class GaussianModel(SplatModel):
    def shake(self):
        self.values["xyz"].add_(0.01)

    def count(self):
        self.counted = True

    def get_features(self):
        return self.values["f_dc"]

    def compute_3D_filter(self):
        self.filter = self.values["xyz"].detach().abs()

    def thin(self):
        for one in self.optimizer.param_groups:
            one["params"][0] = self.values[one["name"]] = torch.nn.Parameter(one["params"][0].detach()[:-1])


def render(viewpoint_camera, pc, kernel_size=0.3):
    return draw(viewpoint_camera, pc.values)


def unknown_fork(argument="", extra="pass", densification=None, before="pass", after="", file=None, helper=""):
    module = types.ModuleType("train")
    own = {"GaussianModel": type("GaussianModel", (GaussianModel,), {}), "render": render, "Scene": Scene}
    module.__dict__.update(own, log=log, pick=pick, photo_loss=photo_loss, torch=torch)
    source = TRAIN.format(argument=argument, extra=extra, before=before, after=after) + helper
    if densification is not None:
        source = source.replace("if iteration < opt.densify_until_iter: pass", densification)
    if file is not None:
        file.write_text(source)
    exec(compile(source, str(file or "train"), "exec"), vars(module))
    return module


def train(module, **options):
    new_log()
    opt = types.SimpleNamespace(iterations=40, densify_until_iter=20, prune_until_iter=30)
    opt.__dict__.update(options)
    module.training(dataset(), opt, None)
