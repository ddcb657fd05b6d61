"""Losses against each other, metrics against definitions, selective Adam against its formula."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from skipgs_plug.fallback_raster import l1_ssim_loss as fused_loss
from skipgs_plug.trainer import InputError, metrics
from skipgs_plug.trainer.loss import l1_ssim_loss
from skipgs_plug.trainer.selective_adam import SelectiveAdam


def test_plain_loss_equals_the_fused_one() -> None:
    generator = torch.Generator().manual_seed(1)
    target = torch.rand(23, 30, 3, generator=generator)
    values, gradients = [], []
    for loss in (l1_ssim_loss, fused_loss):
        image = (target * 0.8 + 0.1).requires_grad_()
        value = loss(image, target, 0.2)
        value.backward()
        values.append(value.detach())
        gradients.append(image.grad)
    torch.testing.assert_close(values[0], values[1], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(gradients[0], gradients[1], atol=1e-7, rtol=1e-3)


def test_psnr_clamps_and_ssim_of_equal_images_is_one() -> None:
    target = torch.rand(20, 20, 3, generator=torch.Generator().manual_seed(2))
    assert metrics.psnr(target, target) == 100.0  # the PSNR of an exact image, a number that JSON can hold
    assert metrics.psnr(torch.full((4, 4, 3), 7.0), torch.full((4, 4, 3), 0.9)) == pytest.approx(20.0, abs=1e-4)
    assert metrics.ssim(target, target) == pytest.approx(1.0)


def test_lpips_names_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(InputError, match=r"LPIPS needs (torchvision|the backbone weights .*alexnet)"):
        metrics.require_lpips("alex")


def test_selective_adam_leaves_hidden_rows_alone() -> None:
    start = torch.arange(6.0).reshape(3, 2)
    param = torch.nn.Parameter(start.clone())
    optimizer = SelectiveAdam([param], eps=1e-15)
    optimizer.param_groups[0]["lr"] = 0.1
    param.grad = torch.full((3, 2), 2.0)
    optimizer.step(torch.tensor([True, False, True]))
    # Without bias correction the first step is lr * (1 - b1) g / sqrt((1 - b2) g^2).
    expected = start - torch.tensor([[1.0], [0.0], [1.0]]) * 0.1 * 0.1 / math.sqrt(0.001)
    torch.testing.assert_close(param.detach(), expected)
    param.grad = None
    before = param.detach().clone()
    optimizer.step(torch.tensor([True, True, True]))
    assert torch.equal(param.detach(), before)
