"""A tiny scene, a model with the methods of Inria's, and a log of a run, for all look-alikes."""

from __future__ import annotations

import copy
import random
from types import SimpleNamespace
from typing import ClassVar

import torch

from skipgs_plug.fallback_raster import rasterization

WIDTH, HEIGHT, N = 16, 12, 30
NAMES = [f"rig{i % 2}/IMG_{i // 2}.png" for i in range(5)]


class Log:
    """Log of a run from inside: backwards, prunes, values at the beginning of each iteration."""

    def __init__(self):
        self.backwards = []  # iterations in which a backward reached a training render
        self.other_backwards = 0  # of renders for other purposes
        self.structure = []  # (iteration, kind, Gaussians left)
        self.happened = []  # (iteration, what): SH raises, saves, evaluations, terms of a loss
        self.behind = {}  # iterations whose gradients stand behind a densification event, by its iteration
        self.pictures = []  # iterations that write a picture to look at
        self.steps = []  # iterations in which an optimizer had something to step with
        self.values = {}  # parameters at the beginning of each iteration
        self.current = []  # parameters themselves, in the latest iteration
        self.now = 0

    def begins(self, iteration, parameters):
        self.now, self.current = iteration, list(parameters)
        self.values[iteration] = [p.detach().clone() for p in self.current]


log = Log()


def new_log():
    """Begin the log of a new run, and seed the random numbers."""
    log.__init__()
    random.seed(0)
    torch.manual_seed(0)


class _Noted(torch.autograd.Function):
    """Identity that notes when a backward comes through."""

    @staticmethod
    def forward(ctx, image, training):
        ctx.training = training
        return image.clone()

    @staticmethod
    def backward(ctx, gradient):
        if ctx.training:
            log.backwards.append(log.now)
        else:
            log.other_backwards += 1
        return gradient, None


def make_cameras(order=0, scale=1):
    """Training cameras of `scale` times the usual size; `uid` is the position in a shuffled list, as in Inria 3DGS."""
    rng = torch.Generator().manual_seed(1)
    cameras = []
    for i, name in enumerate(NAMES):
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([0.3 * i - 0.6, 0.1 * i, 3.0])
        image = torch.rand(3, scale * HEIGHT, scale * WIDTH, generator=rng)
        camera = SimpleNamespace(image_name=name, viewmat=viewmat, original_image=image, world_view_transform=viewmat.T)
        camera.image_height, camera.image_width = image.shape[1:]
        cameras.append(camera)
    random.Random(order).shuffle(cameras)
    for uid, camera in enumerate(cameras):
        camera.uid = uid
    return cameras


def pick(cameras, iteration):
    """The view of an iteration: in a new order each round, and the same in a resumed run."""
    epoch, position = divmod(iteration, len(cameras))
    order = sorted(cameras, key=lambda camera: camera.image_name)
    random.Random(epoch).shuffle(order)
    return order[position]


class SplatModel:
    """The methods of Inria's GaussianModel that trainers and adapters call, with colours in place of SH."""

    adam = torch.optim.Adam
    rates: ClassVar = {"xyz": 0.01, "f_dc": 0.05, "f_rest": 0.05, "opacity": 0.02, "scaling": 0.02, "rotation": 0.01}

    def __init__(self):
        rng = torch.Generator().manual_seed(2)
        start = {
            "xyz": torch.rand(N, 3, generator=rng) * 2 - 1,
            "f_dc": torch.rand(N, 3, generator=rng),
            "f_rest": torch.zeros(N, 3),
            "opacity": torch.rand(N, 1, generator=rng),
            "scaling": torch.full((N, 3), -1.0),
            "rotation": torch.rand(N, 4, generator=rng),
        }
        self.values = {name: torch.nn.Parameter(value) for name, value in start.items()}
        self.gradients_read, self.gathered = 0.0, 0

    def oneupSHdegree(self):
        log.happened.append((log.now, "SH"))

    def training_setup(self, opt=None):
        self.optimizer = self.adam([self.group(name) for name in self.rates], lr=0.0, eps=1e-15)

    def group(self, name):
        return {"params": [self.values[name]], "lr": self.rates[name], "name": name}

    def _optimizers(self):
        return [self.optimizer]

    def update_learning_rate(self, iteration, opt=None):
        for optimizer in self._optimizers():
            for group in optimizer.param_groups:
                if group["name"] == "xyz":
                    group["lr"] = 0.01 * 0.99**iteration

    def add_densification_stats(self, viewspace_points):
        self.gradients_read += float(viewspace_points.grad.norm())  # fails without a backward
        self.gathered += 1

    def prune_points(self, mask):
        for optimizer in self._optimizers():
            for group in optimizer.param_groups:
                old = group["params"][0]
                new = torch.nn.Parameter(old.detach()[~mask])
                state = optimizer.state.pop(old, None)
                if state:
                    optimizer.state[new] = {k: v[~mask] if v.shape == old.shape else v for k, v in state.items()}
                group["params"][0] = self.values[group["name"]] = new
        log.structure.append((log.now, "prune", len(self.values["xyz"])))

    def _prune_gaussians(self, share, scores):
        keep = torch.argsort(scores.flatten(), descending=True)[round(share * len(scores)) :]
        mask = torch.ones(len(scores), dtype=torch.bool)
        mask[keep] = False
        self.prune_points(mask)

    def _densify(self, share, scores=None):
        """Densify, and reset the gathered gradients."""
        self._use_up()
        self._prune_gaussians(share, self.values["opacity"] if scores is None else scores)

    def _use_up(self):
        log.behind[log.now] = self.gathered
        self.gathered = 0

    prune_gaussians = _prune_gaussians  # the name that Speedy-Splat and LightGaussian have for it

    def reset_opacity(self):
        with torch.no_grad():
            self.values["opacity"].clamp_(max=-2.0)
        log.structure.append((log.now, "reset", len(self.values["xyz"])))

    def capture(self):
        return copy.deepcopy(self.__dict__)

    def restore(self, captured, opt=None):
        self.training_setup(opt)
        self.__dict__.update(copy.deepcopy(captured))


def draw(camera, values, training=True, scores=None):
    """Render a view of these values as the Inria family does: image [3, H, W] and the points on screen.

    The log tells backwards of training renders from others; None keeps this one out of it.
    """
    width, height = getattr(camera, "image_width", WIDTH), getattr(camera, "image_height", HEIGHT)
    focal = torch.tensor([[20.0 * width / WIDTH, 0, width / 2], [0, 20.0 * height / HEIGHT, height / 2], [0, 0, 1]])
    colors = torch.sigmoid(values["f_dc"] + values["f_rest"])
    if scores is not None:
        colors = colors * (1 + scores)
    opacity = values["opacity"]
    image, _, info = rasterization(
        values["xyz"],
        values["rotation"],
        torch.exp(values["scaling"]),
        (opacity if getattr(opacity, "frozen", False) else torch.sigmoid(opacity)).flatten(),
        colors,
        camera.viewmat[None],
        focal[None],
        width,
        height,
        packed=False,
    )
    if info["means2d"].requires_grad:
        info["means2d"].retain_grad()
    image = image[0].permute(2, 0, 1)
    if image.requires_grad and training is not None:
        image = _Noted.apply(image, training and scores is None)
    return {"render": image, "viewspace_points": info["means2d"]}


class Scene:
    """The Scene of the Inria family."""

    def __init__(self, dataset, gaussians):
        self.model_path, self.cameras = dataset.model_path, dataset.cameras

    def getTrainCameras(self):
        return self.cameras

    def save(self, iteration):
        log.happened.append((iteration, "save"))


def dataset(order=0):
    return SimpleNamespace(model_path="output", cameras=make_cameras(order), white_background=False)


def options(iterations, last, given, **own):
    """Return the options `opt` of the Inria family's command line; the look-alike stops at `last`."""
    all_have = {
        "densify_from_iter": 2,
        "densify_until_iter": 20,
        "densification_interval": 5,
        "opacity_reset_interval": 8,
        "saving_iterations": [7, 26, iterations],
    }
    return SimpleNamespace(iterations=iterations, last=last, **{**all_have, **own, **given})


def photo_loss(image, camera):
    return (image - camera.original_image).abs().mean()


def note_step(optimizers):
    """Log this iteration when one of the optimizers has a gradient; trainers call it where they step."""
    if any(p.grad is not None for o in optimizers for g in o.param_groups for p in g["params"]):
        log.steps.append(log.now)
