"""Look-alikes of gsplat's simple_trainer.py: `Runner` of 1.5.3 and of HEAD, and its two strategies."""

import dataclasses
from types import SimpleNamespace

import torch
import yaml
from lookalikes.splats import NAMES, SplatModel, draw, log, make_cameras, note_step, photo_loss, pick

ADAPTER, FIRST, START, LAST = "gsplat", 0, 20, 59


@dataclasses.dataclass
class DefaultStrategy:
    refine_start_iter: int = 2
    refine_stop_iter: int = START
    refine_every: int = 5
    reset_every: int = 8
    pause_refine_after_reset: int = 0
    absgrad: bool = False

    def step_pre_backward(self, params, optimizers, state, step, info):
        info["means2d"].retain_grad()

    def step_post_backward(self, params, optimizers, state, step, info, packed=False):
        if step >= self.refine_stop_iter:
            return
        state["grad2d"] = state.get("grad2d", 0.0) + info["means2d"].grad.norm()
        state["gathered"] = state.get("gathered", 0) + 1
        if (
            step > self.refine_start_iter
            and step % self.refine_every == 0
            and step % self.reset_every >= self.pause_refine_after_reset
        ):
            log.behind[step] = state.pop("gathered")
            log.structure.append((step, "grow", len(params["xyz"])))
        if step % self.reset_every == 0 and step > 0:
            log.structure.append((step, "reset", len(params["xyz"])))


@dataclasses.dataclass
class MCMCStrategy:
    refine_stop_iter: int = START
    refine_every: int = 5
    noise_lr: float = 5e5

    def step_pre_backward(self, *args, **kwargs):
        pass

    def step_post_backward(self, params, optimizers, state, step, info, lr):
        if 0 < step < self.refine_stop_iter and step % self.refine_every == 0:
            log.structure.append((step, "relocate", len(params["xyz"])))
            log.behind[step] = 0  # relocation reads no gradients
        with torch.no_grad():
            params["xyz"] += torch.randn_like(params["xyz"]) * lr * self.noise_lr * 2e-7


class Dataset:
    def __init__(self, indices):
        self.indices = indices

    def __len__(self):
        return len(self.indices)


class Runner:
    def __init__(self, strategy, batch_size=1, world_size=1, result_dir="output", **options):
        self.cfg = SimpleNamespace(
            strategy=strategy,
            batch_size=batch_size,
            max_steps=LAST + 1,
            result_dir=result_dir,
            compression=None,
            **options,
        )
        self.world_size = world_size
        self.parser = SimpleNamespace(image_names=sorted([*NAMES, "test/0.png"]))
        names = self.parser.image_names
        self.trainset = Dataset([i for i, name in enumerate(names) if name != "test/0.png"])
        self.images = {names.index(camera.image_name): camera for camera in make_cameras()}
        self.splats = SplatModel().values
        self.optimizers = {
            name: torch.optim.Adam([{"params": value, "lr": 0.02, "name": name}], eps=1e-15)
            for name, value in self.splats.items()
        }
        self.strategy_state = {}

    def rasterize_splats(self, camtoworlds, image_ids=None, **kwargs):
        log.absgrad = self.cfg.strategy.absgrad if isinstance(self.cfg.strategy, DefaultStrategy) else False
        out = [draw(camera, self.splats, None if i else True) for i, camera in enumerate(camtoworlds)]
        return torch.stack([one["render"] for one in out]), None, {"means2d": out[0]["viewspace_points"]}

    def render_training_view(self, **kwargs):
        return self.rasterize_splats(**kwargs)

    def train(self, last=LAST):
        cfg = self.cfg
        yaml.dump(vars(cfg))  # would pickle every attribute of the strategy's instance
        schedulers = [torch.optim.lr_scheduler.ExponentialLR(self.optimizers["xyz"], gamma=0.99)]
        for step in range(last + 1):
            log.begins(step, self.splats.values())
            cameras = [pick(list(self.images.values()), step + i) for i in range(cfg.batch_size)]
            image_ids = torch.tensor([self.trainset.indices.index(self.number_of(camera)) for camera in cameras])
            renders, _, info = self.render_training_view(camtoworlds=cameras, image_ids=image_ids, sh_degree=3)
            cfg.strategy.step_pre_backward(
                params=self.splats, optimizers=self.optimizers, state=self.strategy_state, step=step, info=info
            )
            loss = sum(photo_loss(image, camera) for image, camera in zip(renders, cameras, strict=True))
            loss.backward()
            f"loss={loss.item():.3f}"
            note_step(self.optimizers.values())
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            for scheduler in schedulers:
                scheduler.step()
            lr = schedulers[0].get_last_lr()[0]
            own = {"packed": False} if isinstance(cfg.strategy, DefaultStrategy) else {"lr": lr}
            cfg.strategy.step_post_backward(
                params=self.splats, optimizers=self.optimizers, state=self.strategy_state, step=step, info=info, **own
            )
            if step % 10 == 9:
                self.eval(step)
            if cfg.compression is not None and step in [i - 1 for i in (LAST + 1,)]:
                self.run_compression()

    @torch.no_grad()
    def eval(self, step):
        self.rasterize_splats(camtoworlds=[next(iter(self.images.values()))])

    def run_compression(self):
        for name in self.splats:
            self.splats[name].data = self.splats[name].data.half().float()

    def number_of(self, camera):
        return next(number for number, one in self.images.items() if one is camera)


class Stage:
    """HEAD's: holds the bound method from the moment the runner is built."""

    def __init__(self, function):
        self.function = function

    def render(self, scene_id, **kwargs):
        return self.function(**kwargs)


class HeadRunner(Runner):
    """At HEAD the training view is rendered through a stage, and a PPISP controller is distilled at the end.

    From that iteration on the Gaussians are frozen, the strategy is not called, and the controller alone trains.
    """

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.stage = Stage(self.rasterize_splats)
        self.controller = torch.nn.Parameter(torch.ones(()))
        self.controller_optimizer = torch.optim.Adam([self.controller], lr=0.01)

    def train(self, last=LAST):
        cfg = self.cfg
        distils = getattr(cfg, "post_processing", None) == "ppisp" and cfg.ppisp_controller_distillation
        first = cfg.ppisp_controller_activation_num_steps if distils else last + 1
        super().train(min(last, first - 1))
        for value in self.splats.values():
            value.requires_grad_(False)
        for step in range(first, last + 1):
            camera = pick(list(self.images.values()), step)
            image_ids = torch.tensor([self.trainset.indices.index(self.number_of(camera))])
            renders, _, _ = self.render_training_view(camtoworlds=[camera], image_ids=image_ids, sh_degree=3)
            loss = photo_loss(renders[0] * self.controller, camera)
            loss.backward()
            self.controller_optimizer.step()
            self.controller_optimizer.zero_grad(set_to_none=True)

    def render_training_view(self, **kwargs):
        return self.stage.render("scene", **kwargs)
