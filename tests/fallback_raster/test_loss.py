"""The fused loss against plain convolutions in float64."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from skipgs_plug.fallback_raster import get_num_threads, l1_ssim_loss, set_num_threads

TOLERANCE = 1e-5
BYTES = torch.ones(8, 8, 3, dtype=torch.uint8)


def plain_loss(image: Tensor, target: Tensor, ssim_lambda: float, padding: str) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) with one dense 11x11 convolution per map."""
    offsets = torch.arange(11, dtype=image.dtype) - 5
    line = torch.exp(-(offsets**2) / (2 * 1.5**2))
    line = line / line.sum()
    window = torch.outer(line, line)[None, None]

    def blur(maps: Tensor) -> Tensor:
        planes = maps.reshape(-1, *maps.shape[-3:]).permute(0, 3, 1, 2).flatten(0, 1)
        return F.conv2d(planes[:, None], window, padding=5 if padding == "same" else 0)

    mx, my = blur(image), blur(target)
    vx, vy = blur(image * image) - mx * mx, blur(target * target) - my * my
    covariance = blur(image * target) - mx * my
    ssim = (2 * mx * my + 1e-4) * (2 * covariance + 9e-4) / ((mx * mx + my * my + 1e-4) * (vx + vy + 9e-4))
    return (1 - ssim_lambda) * (image - target).abs().mean() + ssim_lambda * (1 - ssim.mean())


def noisy(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    target = torch.rand(shape)
    return (target + 0.2 * torch.randn(shape)).clamp(0, 1), target


def unrelated(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    return torch.rand(shape), torch.rand(shape)


def nearly_constant(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Bright and flat: E[x^2] - E[x]^2 in float32 would lose half of its digits."""
    target = 0.95 + 0.005 * torch.rand(shape)
    return target + 0.001 * torch.randn(shape), target


def offset_constant(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """The gradient of SSIM is nearly zero here, but its terms are large: plain float32 has an error of 3e-4."""
    return torch.full(shape, 0.9), torch.full(shape, 0.4)


def offset_colours(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Bright and flat, with a different offset for each channel."""
    ramp = torch.linspace(0.1, 0.9, shape[-1]).expand(shape)
    return ramp.contiguous(), (0.8 * ramp).contiguous()


def half_black(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    image, target = noisy(shape)
    left = torch.arange(shape[-2])[:, None] < shape[-2] // 2
    return image.masked_fill(left, 0.0), target


def beyond_one(shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Values outside [0, 1], as in renders."""
    image, target = noisy(shape)
    return 3.0 * image - 1.0, target


PICTURES = [noisy, unrelated, nearly_constant, offset_constant, offset_colours, half_black, beyond_one]
# Sizes around those of a vector (16 floats), the window (11), a band (128 rows) and a chunk (256 floats).
SHAPES = [
    (1, 1, 3),
    (1, 40, 3),
    (40, 1, 3),
    (3, 5, 1),
    (11, 11, 3),
    (32, 16, 1),
    (33, 47, 3),
    (70, 90, 4),
    (2, 67, 17, 3),
    (129, 87, 3),
    (259, 5, 3),
    (5, 260, 1),
    (14, 13, 32),
]


@pytest.fixture
def threads() -> Iterator[Any]:
    previous = get_num_threads()
    yield set_num_threads
    set_num_threads(previous)


@pytest.fixture(autouse=True)
def seed() -> None:
    torch.manual_seed(0)


@pytest.mark.parametrize(
    ("shape", "padding"),
    [(shape, "same") for shape in SHAPES]
    + [(shape, "valid") for shape in SHAPES if min(shape[-3:-1]) >= 11],  # the window must fit
)
@pytest.mark.parametrize("picture", PICTURES)
def test_value_and_gradient(
    picture: Callable[..., tuple[Tensor, Tensor]], shape: tuple[int, ...], padding: Any
) -> None:
    image, target = picture(shape)
    image.requires_grad_()
    exact = image.detach().double().requires_grad_()
    loss, truth = l1_ssim_loss(image, target, 0.2, padding), plain_loss(exact, target.double(), 0.2, padding)
    loss.backward()
    truth.backward()
    assert abs(loss.item() - truth.item()) < TOLERANCE
    assert image.grad is not None and exact.grad is not None
    assert (image.grad - exact.grad).norm() < TOLERANCE * exact.grad.norm()


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_both_terms_alone(padding: Any) -> None:
    image, target = noisy((30, 40, 3))
    for weight in (0.0, 1.0):
        truth = plain_loss(image.double(), target.double(), weight, padding)
        assert abs(l1_ssim_loss(image, target, weight, padding).item() - truth.item()) < 1e-6


def test_equal_images_lose_nothing() -> None:
    image = torch.rand(40, 50, 3, requires_grad=True)
    loss = l1_ssim_loss(image, image.detach().clone())
    loss.backward()
    assert loss.item() == 0.0
    assert image.grad is not None and not image.grad.any()


@pytest.mark.parametrize("shape", [*SHAPES, *((height, 50, 3) for height in range(40, 45))])
def test_value_is_the_same_without_gradient(shape: tuple[int, ...]) -> None:
    for _ in range(10):
        image, target = noisy(shape)
        assert torch.equal(l1_ssim_loss(image, target), l1_ssim_loss(image.requires_grad_(), target).detach())


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_bit_equal_for_any_number_of_threads(threads: Any, padding: Any) -> None:
    image, target = noisy((150, 170, 3))
    results = []
    for count in (1, 2, 3):
        threads(count)
        leaf = image.clone().requires_grad_()
        loss = l1_ssim_loss(leaf, target, 0.2, padding)
        loss.backward()
        results.append((loss.detach(), leaf.grad))
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0]) and torch.equal(gradient, results[0][1])


def test_gradient_is_scaled_and_accumulated() -> None:
    image, target = noisy((20, 30, 3))
    image.requires_grad_()
    loss = l1_ssim_loss(image, target)
    (once,) = torch.autograd.grad(loss, image, retain_graph=True)
    once = once.clone()
    for _ in range(3):
        loss.backward(retain_graph=True)
    (-0.5 * loss).backward()
    assert torch.allclose(image.grad, 2.5 * once, rtol=1e-6, atol=0)


def test_any_strides_and_precisions() -> None:
    image, target = noisy((3, 20, 30))  # channels first, as most code holds images
    loss = l1_ssim_loss(image.permute(1, 2, 0), target.permute(1, 2, 0))
    assert torch.equal(loss, l1_ssim_loss(image.permute(1, 2, 0).contiguous(), target.permute(1, 2, 0).contiguous()))
    leaf = image.double().permute(1, 2, 0).detach().requires_grad_()
    double = l1_ssim_loss(leaf, target.permute(1, 2, 0).double())
    double.backward()
    assert double.dtype == torch.float64 and leaf.grad.dtype == torch.float64
    assert abs(double.item() - loss.item()) < 1e-7


@pytest.mark.parametrize(
    ("shape", "padding"),
    [*((shape, "same") for shape in SHAPES), *(((16, width, 3), "valid") for width in (11, 16, 85, 90))],
)
def test_a_photograph_in_bytes_counts_in_255ths(shape: tuple[int, ...], padding: Any) -> None:
    photograph = torch.randint(256, shape, dtype=torch.uint8)
    every = photograph.view(-1)[:256]
    every[:] = torch.arange(len(every), dtype=torch.uint8)
    found = []
    for target in (photograph, photograph / 255.0):
        image = torch.full(shape, 0.5, requires_grad=True)
        loss = l1_ssim_loss(image, target, 0.2, padding)
        loss.backward()
        found.append((loss.detach(), image.grad))
    assert torch.equal(found[0][0], found[1][0]) and torch.equal(found[0][1], found[1][1])


def test_nan_stays_visible() -> None:
    image, target = noisy((40, 50, 3))
    image[10, 20, 1] = torch.nan
    assert l1_ssim_loss(image, target).isnan()


@pytest.mark.parametrize(
    ("image", "target", "padding", "message"),
    [
        (torch.rand(8, 8), torch.rand(8, 8), "same", "shape"),
        (torch.rand(8, 8, 3), torch.rand(8, 9, 3), "same", "shape"),
        (torch.rand(0, 8, 3), torch.rand(0, 8, 3), "same", "shape"),
        (torch.rand(3, 8, 40), torch.rand(3, 8, 40), "same", "channels"),
        (torch.ones(8, 8, 3, dtype=torch.uint8), torch.rand(8, 8, 3), "same", "image must be a float"),
        (BYTES, BYTES, "same", "image must be a float"),
        (torch.rand(8, 8, 3), torch.ones(8, 8, 3, dtype=torch.int32), "same", "target must be a float or uint8"),
        (torch.rand(8, 8, 3, device="meta"), torch.rand(8, 8, 3), "same", "CPU"),
        (torch.rand(10, 11, 3), torch.rand(10, 11, 3), "valid", "11x10"),
        (torch.rand(11, 10, 3), torch.rand(11, 10, 3), "valid", "at least 11x11"),
        (torch.rand(8, 8, 3), torch.rand(8, 8, 3), "reflect", "padding"),
        (torch.rand(8, 8, 3), torch.rand(8, 8, 3, requires_grad=True), "same", "target.detach"),
    ],
)
def test_bad_input_is_named(image: Tensor, target: Tensor, padding: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        l1_ssim_loss(image, target, 0.2, padding)
