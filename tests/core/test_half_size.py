"""Photographs at half their size: their values, and the loss that decides about them."""

import math

import pytest
import torch

from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.half_size import (
    JUDGED,
    MOST_PIXELS,
    Kept,
    can_be_halved,
    halved,
    judged_tiles,
    kept_at_half_size,
    psnr_at_half_size,
    some_of,
    ssim_at_half_size,
)
from skipgs_plug.core.pace.half_size import HalfSize
from skipgs_plug.core.pace.phase import Phase, PhasePlan


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
    fine, plain, both = (
        (psnr_at_half_size(tiles), ssim_at_half_size(tiles)) for tiles in ([stripes], [smooth], [smooth, stripes])
    )
    assert fine[0] == pytest.approx(-10 * math.log10(0.25), abs=1e-3) and fine[1] < 0.1
    assert plain[0] > 45 and plain[1] > 0.99
    errors = [10 ** (-psnr / 10) for psnr in (fine[0], plain[0])]  # those of the tiles of one photograph
    assert both == pytest.approx([-10 * math.log10(sum(errors) / 2), (fine[1] + plain[1]) / 2])
    assert math.isfinite(psnr_at_half_size([torch.zeros(3, 30, 30)]))
    # Where the PSNR is too low, SSIM is not computed.
    assert kept_at_half_size(lambda: [stripes]) == (pytest.approx(fine[0]), None)
    assert kept_at_half_size(lambda: [smooth]) == pytest.approx(plain)
    assert kept_at_half_size(lambda: [smooth, stripes]).psnr == pytest.approx((fine[0] + plain[0]) / 2)


@pytest.mark.parametrize("size", [(1500, 2000), (2001, 977), (40, 60_000)])
def test_large_photographs_are_judged_in_tiles_that_are_spread(size):
    photograph = torch.arange(size[0] * size[1]).reshape(1, *size).expand(3, *size)
    tiles = judged_tiles(photograph)
    assert len(tiles) == 9 and len({tile.shape for tile in tiles}) == 1
    assert min(tiles[0].shape[1:]) >= 22 and 9 * tiles[0][0].numel() <= 4 * MOST_PIXELS  # a narrow one has wider tiles
    assert torch.equal(tiles[0][0, 0, 0], photograph[0, 0, 0]) and torch.equal(
        tiles[-1][0, -1, -1], photograph[0, -1, -1]
    )
    middle = tiles[4][0, tiles[4].shape[1] // 2, tiles[4].shape[2] // 2]
    assert abs(int(middle) // size[1] - size[0] // 2) <= 2 and abs(int(middle) % size[1] - size[1] // 2) <= 2
    assert not any(tile.untyped_storage().nbytes() > tile.nbytes for tile in tiles)  # the photograph is not kept
    small = photograph[:, :100, :100]
    assert judged_tiles(small)[0] is small


def test_large_plain_areas_do_not_hide_lost_detail():
    texture = torch.rand(3, 96, 96, generator=torch.Generator().manual_seed(0)) * 0.09  # a faint one: its PSNR is high
    kept = kept_at_half_size(lambda: [texture])
    assert kept.psnr > 32 and kept.ssim < 0.9 and not kept.enough
    assert Kept(33.0, 0.95).enough and not Kept(31.0, 0.95).enough and not Kept(33.0, None).enough


@pytest.mark.parametrize(("shade", "until"), [(1.0, 0), (0.0, 50)])
def test_the_decision_outlasts_a_checkpoint(shade, until):
    photographs = [shade * torch.rand(3, 32, 32)]  # noise, or black
    plan = PhasePlan(range(80), {}, set(), 99, Phase(), None, None, None, False, lambda: photographs)
    begun = HalfSize(SkipConfig(share="auto"))
    begun.begin(plan)
    report = begun.report()
    assert report["half_size_until"] == until and ((report["half_size_ssim"] or 0.0) > 0.92) == bool(until)
    resumed = HalfSize(SkipConfig(share="auto"))
    resumed.load_state_dict(begun.state_dict())
    assert resumed.report() == report
    resumed.load_state_dict([until, 33.0])  # of a version that took the PSNR alone
    assert resumed.report() == {"half_size_until": until, "half_size_psnr": None, "half_size_ssim": None}


def test_the_photographs_that_decide_are_spread_over_all():
    assert some_of(1) == [0] and some_of(3) == [0, 1, 2]
    chosen = some_of(100)
    assert len(set(chosen)) == JUDGED and (chosen[0], chosen[-1]) == (0, 99)
