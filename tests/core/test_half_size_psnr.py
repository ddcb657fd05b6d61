"""Photographs at half their size: their values, and the loss that decides about them."""

import math

import pytest
import torch

from skipgs_plug.core.half_size import JUDGED, can_be_halved, half_size_psnr, halved, some_of


def test_each_value_is_the_mean_of_four():
    pixels = torch.rand(2, 3, 12, 16)
    expected = pixels.reshape(2, 3, 6, 2, 8, 2).mean(dim=(3, 5))
    torch.testing.assert_close(halved(pixels), expected)


def test_an_odd_size_is_rounded_down_and_covers_the_whole_image():
    columns = torch.arange(33.0).expand(25, 33)
    smaller = halved(columns)
    assert smaller.shape == (12, 16)
    assert smaller[0, 0] == pytest.approx(1, abs=0.5) and smaller[0, -1] == pytest.approx(31, abs=0.5)


def test_a_pixel_counts_if_all_pixels_under_it_count():
    mask = torch.rand(1, 24, 32) < 0.8
    smaller = halved(mask)
    assert smaller.dtype == torch.bool and smaller.any() and not smaller.all()
    assert torch.equal(smaller, mask.reshape(1, 12, 2, 16, 2).all(dim=4).all(dim=2))


@pytest.mark.parametrize(("size", "possible"), [((22, 400), True), ((21, 400), False), ((400, 21), False)])
def test_half_the_size_must_hold_the_window_of_ssim(size, possible):
    assert can_be_halved(*size) == possible


def test_photographs_with_fine_detail_lose_more():
    stripes = (torch.arange(64) % 2).float().expand(3, 64, 64)  # half the size is grey
    smooth = torch.linspace(0, 1, 64).expand(3, 64, 64)
    assert half_size_psnr([stripes]) == pytest.approx(-10 * math.log10(0.25), abs=1e-3)
    assert half_size_psnr([smooth]) > 45
    mean = (half_size_psnr([smooth]) + half_size_psnr([stripes])) / 2
    assert half_size_psnr([smooth, stripes]) == pytest.approx(mean)
    assert math.isfinite(half_size_psnr([torch.zeros(3, 30, 30)]))


def test_the_photographs_that_decide_are_spread_over_all():
    assert some_of(1) == [0] and some_of(3) == [0, 1, 2]
    chosen = some_of(100)
    assert len(set(chosen)) == JUDGED and (chosen[0], chosen[-1]) == (0, 99)
