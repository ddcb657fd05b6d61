"""Per-Gaussian statistics of the stand-ins, compared with dense compositing and the rasterizer's gradients."""

import pytest
import torch
from compat_scenes import HEIGHT, WIDTH, camera, gaussians, intrinsics, oracle

from skipgs_plug.compat.compose import render, splats
from skipgs_plug.compat.inria import GaussianRasterizationSettings
from skipgs_plug.compat.pairs import pairs_by_strip, squared_gradients, strongest
from skipgs_plug.compat.statistics import Footprint, gather


@pytest.fixture
def footprint():
    with torch.no_grad():
        return render(GaussianRasterizationSettings(**camera()), splats(**gaussians())).footprint


def dense(f):
    """Return falloff, alpha and transmittance of every pixel and Gaussian, composited one by one."""
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


def test_statistics_are_those_of_dense_compositing(footprint):
    _, alpha, light, _ = dense(footprint)
    values = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2))
    found = gather(footprint, values)
    hit, weight = (alpha > 0).double(), (alpha * light).detach()
    assert torch.equal(found.pixels, hit.sum(0).int())
    assert torch.equal(found.contributions.flatten(), hit.sum(1).int())
    value = values.reshape(-1, 1).double()
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    distance = torch.cdist(torch.stack([x, y], -1).reshape(-1, 2).double(), footprint.means2d.double())
    expected = (weight, hit * light, hit * value, weight * value, hit * distance)
    for one, other in zip(found[1:6], expected, strict=True):
        torch.testing.assert_close(one.double(), other.sum(0), rtol=1e-4, atol=1e-4)
    best = weight.amax(1)
    assert torch.equal(found.strongest.flatten() >= 0, best > 0)
    torch.testing.assert_close(weight.gather(1, found.strongest.flatten().clamp_min(0).long()[:, None])[:, 0], best)


def test_statistics_of_the_kernel_are_those_of_the_pairs(footprint):
    found = gather(footprint)
    count, weight = torch.zeros(2, len(footprint))
    for pairs in pairs_by_strip(footprint):
        count.index_add_(0, pairs.gaussian, torch.ones(len(pairs.gaussian)))
        weight.index_add_(0, pairs.gaussian, pairs.weight)
        rows = strongest(pairs)
        assert torch.equal(found.strongest.flatten()[pairs.pixel[rows]], pairs.gaussian[rows].int())
    assert torch.equal(found.pixels, count.int()) and (found.value == 0).all()
    torch.testing.assert_close(found.weight, weight)


def test_statistics_of_nothing_are_zero(footprint):
    blind = Footprint(*footprint[:4], torch.zeros_like(footprint.drawn), WIDTH, HEIGHT)
    nothing = gather(blind)
    assert not any(one.any() for one in nothing[:-1]) and (nothing.strongest == -1).all()


def test_blend_weights_are_the_gradient_of_the_image_by_the_colours(footprint):
    scene = gaussians()
    colors = torch.rand(len(scene["means3D"]), 3).double().requires_grad_()
    image, _ = oracle(scene, camera(), intrinsics(), colors=colors, sh_degree=None)
    image[0].sum().backward()
    weights = gather(footprint).weight
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
