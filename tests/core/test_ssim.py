"""SSIM equals that of torchmetrics, which is not loaded for it."""

from __future__ import annotations

import pytest
import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from skipgs_plug.core import ssim as ssim_module
from skipgs_plug.core.ssim import ssim_map
from skipgs_plug.trainer.metrics import batch, ssim


@pytest.mark.parametrize(("height", "width"), [(11, 11), (40, 57), (64, 200)])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.5])
def test_it_is_that_of_torchmetrics(height: int, width: int, noise: float) -> None:
    generator = torch.Generator().manual_seed(height + width)
    rows, columns = torch.meshgrid(torch.arange(height) / 9, torch.arange(width) / 7, indexing="ij")
    target = torch.stack([rows.sin(), columns.cos(), (rows * columns).sin()], dim=-1) / 2 + 0.5
    render = target + noise * torch.randn(target.shape, generator=generator)
    images = batch(render.clamp(0, 1)), batch(target)
    mean, windows = structural_similarity_index_measure(*images, data_range=1.0, return_full_image=True)
    assert ssim(render, target) == pytest.approx(float(mean), abs=1e-5)
    assert torch.allclose(
        ssim_map(render.clamp(0, 1), target), windows[0].permute(1, 2, 0), atol=1e-3
    )  # float32 cancels in variances
    mask = rows > 0.5
    masked = float(windows[0].permute(1, 2, 0)[mask].mean())
    assert ssim(render, target, mask) == pytest.approx(masked, abs=1e-5)


def test_blocks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = torch.rand(2, 53, 40, 3, generator=torch.Generator().manual_seed(0))
    whole = ssim_map(first, second)
    monkeypatch.setattr(ssim_module, "BLOCK", (10, 16))  # the last ones are 3 rows high and 8 columns wide
    assert torch.equal(ssim_map(first, second), whole)
