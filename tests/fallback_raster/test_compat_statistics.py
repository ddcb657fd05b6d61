"""Per-Gaussian statistics of the stand-ins, against dense compositing and the rasterizer's own gradients."""

import pytest
import torch
from compat_scenes import HEIGHT, WIDTH, camera, gaussians, intrinsics, oracle

from skipgs_plug.fallback_raster.compat.inria import GaussianRasterizationSettings
from skipgs_plug.fallback_raster.compat.rendering import render, splats
from skipgs_plug.fallback_raster.compat.statistics import (
    count_per_gaussian,
    pairs_by_strip,
    squared_gradients,
    strongest,
    sum_per_gaussian,
)


@pytest.fixture
def footprint():
    with torch.no_grad():
        return render(GaussianRasterizationSettings(**camera()), splats(**gaussians())).footprint


def dense(f):
    """Falloff, alpha and transmittance of every pixel and Gaussian, composited in the plainest way."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    offset = torch.stack([x, y], -1).reshape(-1, 1, 2).double() - f.means2d.double()
    a, b, c = f.conics.double().unbind(-1)
    sigma = 0.5 * (a * offset[..., 0] ** 2 + c * offset[..., 1] ** 2) + b * offset[..., 0] * offset[..., 1]
    falloff = torch.exp(-sigma).requires_grad_()
    alpha = torch.zeros_like(falloff)
    light = torch.zeros_like(falloff)
    left = torch.ones(len(falloff), dtype=torch.float64)
    alive = torch.ones(len(falloff), dtype=torch.bool)
    for i in torch.argsort(f.depths).tolist():
        value = (f.opacities[i].double() * falloff[:, i]).clamp_max(0.999)
        takes = alive & f.drawn[i] & (value >= 1 / 255)
        alive = alive & ~(takes & (left * (1 - value) <= 1e-4))
        takes = takes & alive
        alpha = alpha.index_copy(1, torch.tensor([i]), torch.where(takes, value, 0.0)[:, None])
        light = light.index_copy(1, torch.tensor([i]), left[:, None])
        left = left * torch.where(takes, 1 - value, 1.0)
    return falloff, alpha, light, left


def test_contributions_are_those_of_dense_compositing(footprint):
    _, alpha, light, _ = dense(footprint)
    assert torch.equal(count_per_gaussian(footprint), (alpha > 0).sum(0).int())
    torch.testing.assert_close(
        sum_per_gaussian(footprint, lambda p: p.weight).double(),
        (alpha * light).sum(0).detach(),
        rtol=1e-4,
        atol=1e-5,
    )
    pixels = torch.arange(HEIGHT * WIDTH) % 3 == 0
    counted = count_per_gaussian(footprint, lambda p: pixels[p.pixel])
    assert torch.equal(counted, (alpha[pixels] > 0).sum(0).int())


def test_blend_weights_are_the_gradient_of_the_image_by_the_colours(footprint):
    scene = gaussians()
    colors = torch.rand(len(scene["means3D"]), 3).double().requires_grad_()
    image, _ = oracle(scene, camera(), intrinsics(), colors=colors, sh_degree=None)
    image[0].sum().backward()
    weights = sum_per_gaussian(footprint, lambda p: p.weight)
    torch.testing.assert_close(weights.double(), colors.grad[:, 0], rtol=1e-3, atol=1e-4)


def test_strongest_is_the_largest_weight_of_each_pixel(footprint):
    _, alpha, light, _ = dense(footprint)
    weight = (alpha * light).detach()
    for pairs in pairs_by_strip(footprint):
        rows = strongest(pairs)
        pixel, gaussian = pairs.pixel[rows], pairs.gaussian[rows]
        torch.testing.assert_close(weight[pixel, gaussian], weight[pixel].amax(1))
        assert torch.equal(pixel, pairs.pixel.unique())


def test_squared_gradients_are_squared_before_the_sum(footprint):
    rng = torch.Generator().manual_seed(1)
    rgb = torch.rand(len(footprint), 3, generator=rng)
    grad = torch.randn(3, HEIGHT, WIDTH, generator=rng)
    background = camera()["bg"]
    falloff, alpha, light, left = dense(footprint)
    image = (alpha * light) @ rgb.double() + left[:, None] * background.double()
    (image * grad.reshape(3, -1).T).sum().backward()
    expected = falloff.grad.square().sum(0)
    found = squared_gradients(footprint, rgb, background, grad).double()
    torch.testing.assert_close(found / expected.max(), expected / expected.max(), rtol=1e-3, atol=1e-5)
