"""Masked pixels: where they come from, and that nothing is learnt or measured there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scene_folders import write_colmap

from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer, load_scene, metrics, save_packed
from skipgs_plug.trainer.mask import leave_out

HIDDEN = (slice(4, 20), slice(6, 25))


def drawn(value: int = 0, size: tuple[int, int] = (32, 24)) -> Image.Image:
    mask = np.full((24, 32), 255, dtype=np.uint8)
    mask[HIDDEN] = value
    return Image.fromarray(mask).resize(size, Image.Resampling.NEAREST)


@pytest.mark.parametrize("name", ["view_001.png.png", "view_001.png"])
def test_folder_of_masks(tmp_path: Path, tiny_scene: Scene, name: str, caplog: pytest.LogCaptureFixture) -> None:
    folder = write_colmap(tiny_scene, tmp_path / "scan")
    (folder / "masks/cam").mkdir(parents=True)
    drawn(size=(64, 48)).save(folder / "masks/cam" / name)
    scene = load_scene(folder)
    mask = scene.train[0].mask
    assert mask is not None and not mask[HIDDEN].any() and int(mask.sum()) == 24 * 32 - 16 * 19
    assert all(view.mask is None for view in scene.train[1:])
    assert "9 of 10 views have no mask" in caplog.text
    save_packed(scene, tmp_path / "scene.npz")
    packed = load_scene(tmp_path / "scene.npz").train
    assert packed[0].mask is not None and torch.equal(packed[0].mask, mask) and packed[1].mask is None
    assert torch.equal(packed[0].image, scene.train[0].image)
    drawn(size=(24, 32)).save(folder / "masks/cam" / name)
    with pytest.raises(InputError, match=rf"masks/cam/{name} is 24x32, but its camera is 32x24"):
        load_scene(folder)
    Image.new("L", (32, 24)).save(folder / "masks/cam" / name)
    with pytest.raises(InputError, match=r"the mask of 'cam/view_001\.png' leaves no pixel"):
        load_scene(folder)


def test_nothing_is_learnt_from_hidden_pixels(trainer: Trainer) -> None:
    view = trainer.scene.train[0]
    mask = torch.ones(view.height, view.width, dtype=torch.bool)
    mask[HIDDEN] = False
    image = trainer.render(view).requires_grad_()
    other = image.detach().clone()
    other[HIDDEN] += 0.3
    other.requires_grad_()
    target = view.image.float() / 255
    losses = []
    for render in (image, other):
        loss = trainer.backend.loss(*leave_out(render, target, mask), 0.2)
        loss.backward()
        losses.append(float(loss.detach()))
        assert not render.grad[HIDDEN].any() and render.grad[mask].any()
    assert losses[0] == losses[1]
    torch.testing.assert_close(image.grad, other.grad, rtol=0, atol=0)


def test_training_ignores_what_is_hidden(tiny_scene: Scene, tiny_config: TrainConfig) -> None:
    """Two scenes that differ behind the mask alone give the same parameters, bit for bit."""
    results = []
    for colour in (0, 255):
        views = []
        for view in tiny_scene.train:
            mask = torch.ones(view.height, view.width, dtype=torch.bool)
            mask[HIDDEN] = False
            image = view.image.clone()
            image[HIDDEN] = colour
            views.append(type(view)(view.name, image, view.K, view.viewmat, mask))
        scene = Scene(**{**vars(tiny_scene), "train": views})
        trainer = Trainer(tiny_config, scene)
        trainer.train(until=12, progress=False)
        results.append(trainer.snapshot()["splats"])
        stats = trainer.evaluate("train")
        results.append((stats["psnr"], stats["ssim"]))
    assert all(torch.equal(results[0][name], results[2][name]) for name in results[0])
    assert results[1] == results[3]


def test_metrics_count_what_is_seen() -> None:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(24, 32, 3, generator=generator)
    mask = torch.ones(24, 32, dtype=torch.bool)
    assert metrics.psnr(target * 0.9, target, mask) == pytest.approx(metrics.psnr(target * 0.9, target))
    mask[:, 20:] = False
    wrong = target.clone()
    wrong[:, 20:] = 0
    assert metrics.psnr(wrong, target, mask) == 100.0
    assert metrics.ssim(target, target, mask) == pytest.approx(1.0)
    # Windows far from the hidden columns do not contain them.
    mask[:] = False
    mask[:, :12] = True
    noisy = (target + 0.1 * torch.rand(24, 32, 3, generator=generator)).clamp(0, 1)
    darker = noisy.clone()
    darker[:, 20:] = 0
    assert metrics.ssim(noisy, target, mask) == pytest.approx(metrics.ssim(darker, target, mask))
