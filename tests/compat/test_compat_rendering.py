"""The render call behind the stand-ins, against the reference rasterizer."""

import pytest
import torch
from compat_scenes import HEIGHT, WIDTH, camera, gaussians, intrinsics, oracle

from skipgs_plug.compat.compose import render, splats
from skipgs_plug.compat.inria import GaussianRasterizationSettings

TOLERANCE = {"rtol": 2e-3, "atol": 2e-5}


def settings(**changes):
    return GaussianRasterizationSettings(**(camera() | changes))


def picture_weights():
    return torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(7))


@pytest.mark.parametrize("shift_x", [0.0, 0.2])
@pytest.mark.parametrize("scale_modifier", [1.0, 0.7])
def test_image_is_the_references(shift_x, scale_modifier):
    fields = camera(shift_x) | {"scale_modifier": scale_modifier}
    with torch.no_grad():
        result = render(GaussianRasterizationSettings(**fields), splats(**gaussians()))
        expected, _ = oracle(gaussians(), fields, intrinsics(shift_x))
    torch.testing.assert_close(result.color.double(), expected, **TOLERANCE)


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_are_the_references(antialiased):
    ours, theirs, weights = gaussians(), gaussians(), picture_weights()
    result = render(settings(), splats(**ours), antialiased=antialiased)
    (result.color * weights).sum().backward()
    mode = "antialiased" if antialiased else "classic"
    expected, info = oracle(theirs, camera(), intrinsics(), rasterize_mode=mode)
    info["means2d"].retain_grad()
    (expected * weights).sum().backward()
    for name in ("means3D", "opacities", "shs", "scales"):
        scale = theirs[name].grad.abs().max()
        torch.testing.assert_close(ours[name].grad / scale, theirs[name].grad / scale, **TOLERANCE)
    ndc = info["means2d"].grad[0] * torch.tensor([WIDTH / 2, HEIGHT / 2])
    scale = ndc.abs().max()
    torch.testing.assert_close(ours["means2D"].grad[:, :2].double() / scale, ndc / scale, **TOLERANCE)
    assert (ours["means2D"].grad[:, 2] == 0).all()


def test_four_columns_ask_for_absolute_gradients():
    ours, theirs, weights = gaussians(), gaussians(), picture_weights()
    ours["means2D"] = torch.zeros(len(ours["means3D"]), 4, requires_grad=True)
    (render(settings(), splats(**ours)).color * weights).sum().backward()
    expected, info = oracle(theirs, camera(), intrinsics(), absgrad=True)
    (expected * weights).sum().backward()
    ndc = info["means2d"].absgrad[0] * torch.tensor([WIDTH / 2, HEIGHT / 2])
    gradient = ours["means2D"].grad.double()
    torch.testing.assert_close(gradient[:, 2:] / ndc.max(), ndc / ndc.max(), **TOLERANCE)
    assert (gradient[:, 2:] >= gradient[:, :2].abs() * (1 - 1e-4)).all()


def test_gradient_reaches_a_means2d_that_is_no_leaf():
    scene = gaussians()
    points = torch.zeros_like(scene["means3D"], requires_grad=True) + 0
    points.retain_grad()
    render(settings(), splats(**(scene | {"means2D": points}))).color.square().sum().backward()
    assert points.grad is not None and points.grad.abs().sum() > 0


def test_degree_zero_may_come_apart():
    whole, parted = gaussians(), gaussians()
    shs = parted.pop("shs").detach()
    dc, rest = shs[:, :1].clone().requires_grad_(), shs[:, 1:].clone().requires_grad_()
    first = render(settings(), splats(**whole)).color
    second = render(settings(), splats(**parted, dc=dc, shs=rest)).color
    assert torch.equal(first, second)
    first.sum().backward()
    second.sum().backward()
    torch.testing.assert_close(torch.cat([dc.grad, rest.grad], dim=1), whole["shs"].grad)


def test_inverse_depth_is_blended_and_differentiable():
    ours, theirs = gaussians(), gaussians()
    result = render(settings(), splats(**ours), inverse_depth=True)
    depth = theirs["means3D"].double() @ camera()["viewmatrix"].double()[:3, 2] + camera()["viewmatrix"][3, 2]
    expected, _ = oracle(
        theirs,
        camera(),
        intrinsics(),
        colors=(1 / depth)[:, None],
        sh_degree=None,
        backgrounds=torch.zeros(1, 1),
    )
    torch.testing.assert_close(result.inverse_depth.double(), expected, **TOLERANCE)
    result.inverse_depth.square().sum().backward()
    expected.square().sum().backward()
    scale = theirs["means3D"].grad.abs().max()
    torch.testing.assert_close(ours["means3D"].grad / scale, theirs["means3D"].grad / scale, **TOLERANCE)


def test_radii_are_three_deviations_of_the_wider_axis():
    with torch.no_grad():
        result = render(settings(), splats(**gaussians()))
        _, info = oracle(gaussians(), camera(), intrinsics())
    a, b, c = info["conics"][0].unbind(-1)
    covariances = torch.linalg.inv(torch.stack([a, b, b, c], -1).reshape(-1, 2, 2)[result.radii > 0])
    beyond = result.radii[result.radii > 0] - 3 * torch.linalg.eigvalsh(covariances)[:, 1].sqrt()
    assert beyond.min() > -1e-3 and beyond.max() < 1.5
    assert torch.equal(result.radii > 0, (info["radii"][0] > 0).all(-1))


def test_a_skipped_backward_leaves_no_gradient_and_no_graph_under_no_grad():
    scene = gaussians()
    render(settings(), splats(**scene))
    assert all(value.grad is None for value in scene.values())
    with torch.no_grad():
        assert not render(settings(), splats(**scene)).color.requires_grad


def test_precomputed_colours_are_drawn_as_they_are():
    scene = gaussians()
    shs = scene.pop("shs")
    colors = torch.rand(len(shs), 3, generator=torch.Generator().manual_seed(3)).requires_grad_()
    result = render(settings(), splats(**scene, colors_precomp=colors, shs=torch.empty(0)))
    expected, _ = oracle(scene, camera(), intrinsics(), colors=colors, sh_degree=None)
    torch.testing.assert_close(result.color.double(), expected, **TOLERANCE)


def test_unsupported_arguments_are_refused():
    scene = gaussians()
    with pytest.raises(NotImplementedError, match="compute_cov3D_python"):
        splats(**(scene | {"scales": None, "rotations": None}), cov3D_precomp=torch.rand(30, 6))
    with pytest.raises(ValueError, match="either shs or colors_precomp"):
        splats(**scene, colors_precomp=torch.rand(30, 3))
