"""Look-alike of LiteGS's training module: epochs over a DataLoader, densified after each, sparse steps."""

from types import SimpleNamespace

import torch
from lookalikes.splats import NAMES, SplatModel, draw, log, make_cameras, note_step, photo_loss

ADAPTER, FIRST, START, LAST = "litegs", 0, 20, 59


class StatisticsHelperInst:
    active = False


class DensityControllerTamingGS:
    def __init__(self, until):
        self.until = until

    def prune(self, optimizer, epoch):
        optimizer.model.prune_gaussians(0.05, optimizer.model.values["opacity"])

    def reset_opacity(self, optimizer, epoch):
        optimizer.model.reset_opacity()

    def step(self, optimizer, epoch):
        if epoch < self.until:
            if epoch % 2 == 0:
                self.prune(optimizer, epoch)
            if epoch % 3 == 0:
                self.reset_opacity(optimizer, epoch)


def render_preprocess(*arguments):
    return arguments[4]


densify = SimpleNamespace(DensityControllerTamingGS=DensityControllerTamingGS)
render = SimpleNamespace(render_preprocess=render_preprocess)


def start(lp, op, pp, dp, state=None):
    cameras = {camera.image_name: camera for camera in make_cameras()}
    trainingset = SimpleNamespace(frames=[SimpleNamespace(name=name) for name in NAMES])
    train_loader = range(len(NAMES))
    model, start_epoch = (SplatModel(), 0) if state is None else state
    if state is None:
        model.training_setup()
    opt = model.optimizer
    opt.model = model
    total_epoch = op.epochs
    density_controller = densify.DensityControllerTamingGS(dp.densify_until)
    for epoch in range(start_epoch, total_epoch):
        order = torch.randperm(len(NAMES), generator=torch.Generator().manual_seed(epoch)).tolist()
        for number, place in enumerate(order):
            log.begins(epoch * len(train_loader) + number, model.values.values())
            idx_tensor = torch.tensor([place], device="cpu")  # as a DataLoader gives it
            values = render.render_preprocess(*[None] * 4, model.values, *[None] * 6, idx_tensor, pp, 3)
            camera = cameras[trainingset.frames[place].name]
            rendered = draw(camera, values)
            loss = photo_loss(rendered["render"], camera)
            loss.backward()
            if epoch < dp.densify_until:
                model.add_densification_stats(rendered["viewspace_points"])
            note_step([opt])
            opt.step()
            opt.zero_grad(set_to_none=True)
        with torch.no_grad():
            render.render_preprocess(*[None] * 4, model.values, *[None] * 6, idx_tensor, pp, 3)  # evaluation
        density_controller.step(opt, epoch)
    return model, total_epoch


def train(last=LAST, state=None):
    parameters = SimpleNamespace(model_path="results")
    steps = SimpleNamespace(epochs=(last + 1) // len(NAMES))
    return start(parameters, steps, None, SimpleNamespace(densify_until=4), state)
