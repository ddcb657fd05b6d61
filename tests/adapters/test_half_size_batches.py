"""gsplat's Runner grows on batches of half the size, and evaluations see the photographs as they are."""

from types import SimpleNamespace

import pytest
import torch
from lookalikes.gsplat_runner import LAST, START, DefaultStrategy, Runner
from lookalikes.splats import draw, log, make_cameras, new_log
from torch.utils.data import DataLoader

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.adapters.half_size_batches import ENTRIES

FULL, HALF = (24, 32), (12, 16)


class Photographs(torch.utils.data.Dataset):
    """Photographs of smooth colours, as the script's dataset hands them out."""

    def __init__(self, cameras, indices, more):
        self.cameras, self.indices, self.more = cameras, indices, more

    def __len__(self):
        return len(self.indices)

    def __getitem__(self, item):
        ramp = torch.linspace(0, 255, FULL[1])[:, None].expand(*FULL, 3)
        K = torch.tensor([[40.0, 0, FULL[1] / 2], [0, 40.0, FULL[0] / 2], [0, 0, 1]])
        mask = torch.ones(FULL, dtype=torch.bool)
        return {"K": K, "camtoworld": torch.eye(4), "image": ramp, "image_id": item, "mask": mask, **self.more}


class LoadingRunner(Runner):
    """Draws its photographs from a DataLoader, and renders at their size."""

    def __init__(self, more=None, **options):
        super().__init__(DefaultStrategy(), **{"patch_size": None, **options})
        self.device = "cpu"
        self.trainset = Photographs(make_cameras(scale=2), self.trainset.indices, more or {})
        self.sizes, self.evaluated = {}, set()

    def rasterize_splats(self, camtoworlds, image_ids=None, width=FULL[1], height=FULL[0], **kwargs):
        camera = self.trainset.cameras[0]
        view = SimpleNamespace(viewmat=camera.viewmat, image_width=width, image_height=height)
        out = draw(view, self.splats)
        return out["render"].permute(1, 2, 0)[None], None, {"means2d": out["viewspace_points"]}

    def train(self, last=LAST):
        cfg = self.cfg
        loader = DataLoader(self.trainset, batch_size=1, shuffle=True)
        batches = iter(loader)
        for step in range(last + 1):
            try:
                data = next(batches)
            except StopIteration:
                batches = iter(loader)
                data = next(batches)
            log.begins(step, self.splats.values())
            pixels = data["image"] / 255.0
            height, width = pixels.shape[1:3]
            assert data["mask"].shape == pixels.shape[:3] and data["mask"].all()
            assert torch.allclose(data["K"][0, :2, 2], torch.tensor([width / 2, height / 2]))
            self.sizes[step] = (height, width)
            shown = {"image_ids": data["image_id"], "width": width, "height": height}
            renders, _, info = self.rasterize_splats(data["camtoworld"], **shown)
            state = {"params": self.splats, "optimizers": self.optimizers, "state": self.strategy_state}
            cfg.strategy.step_pre_backward(**state, step=step, info=info)
            loss = (renders - pixels).abs().mean()
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            cfg.strategy.step_post_backward(**state, step=step, info=info)
            if step % 10 == 9:
                self.eval(step)

    @torch.no_grad()
    def eval(self, step):
        for data in DataLoader(Photographs(self.trainset.cameras, self.trainset.indices[:1], {}), batch_size=1):
            self.evaluated.add(tuple(data["image"].shape[1:3]))


def train(runner, **settings):
    new_log()
    with SkipGate(runner, **settings) as gate:
        runner.train()
    return gate


def half_sizes(runner):
    return sorted(step for step, size in runner.sizes.items() if size == HALF)


def test_the_scene_grows_on_batches_of_half_the_size():
    runner = LoadingRunner()
    gate = train(runner, share=0.9, half_size=True)
    # The loop is known from the second iteration on.
    assert half_sizes(runner) == [step for step in runner.sizes if 0 < step < START]
    assert runner.evaluated == {FULL}
    assert gate.report()["growing"]["half_size_until"] == START
    assert "__iter__" in vars(DataLoader) and not hasattr(DataLoader.__iter__, "__wrapped__")


def test_auto_asks_the_photographs():
    runner = LoadingRunner()
    gate = train(runner, share="auto")
    assert half_sizes(runner) and gate.report()["growing"]["half_size_psnr"] > 32
    assert "dB and an SSIM of 0.9" in gate.summary()


@pytest.mark.parametrize(
    "runner",
    [
        lambda: LoadingRunner(patch_size=16),
        lambda: LoadingRunner(post_processing="ppisp", ppisp_use_controller=False),
        lambda: LoadingRunner(more={"points": torch.zeros(1, 2)}),
    ],
    ids=["patches", "post-processing", "points in pixels"],
)
def test_a_run_whose_batches_are_not_known_at_half_size_is_left_alone(runner):
    runner = runner()
    assert runner.trainset[0].keys() <= ENTRIES | {"points"}
    train(runner, share="auto")
    assert not half_sizes(runner)
    with pytest.raises(SkipGSError, match="half_size is not possible here"):
        train(runner, share="auto", half_size=True)


def test_other_loaders_of_the_script_are_left_alone():
    runner = LoadingRunner()
    with SkipGate(runner, share=0.9, half_size=True):
        before = DataLoader.__iter__
        other = next(iter(DataLoader(Photographs(runner.trainset.cameras, [0], {}), batch_size=1)))
    assert other["image"].shape[1:3] == FULL and DataLoader.__iter__ is not before
