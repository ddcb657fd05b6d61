"""Every stand-in module returns the right results, is served, and is removed afterwards."""

import importlib
import importlib.util
import math
import os
import shutil
import subprocess
import sys

import pytest
import torch
from compat_scenes import HEIGHT, WIDTH, camera, gaussians, intrinsics, oracle

from skipgs_plug.compat import (
    FAMILIES,
    absgs,
    fastgs,
    gaussianspa,
    improved_gs,
    inria,
    lightgaussian,
    mcmc,
    mip_splatting,
    pixel_gs,
    scaffold_gs,
    serve,
    speedy_splat,
    taming,
)
from skipgs_plug.compat.knn import distCUDA2
from skipgs_plug.compat.settings import settings_class
from skipgs_plug.compat.sparse_adam import SparseGaussianAdam
from skipgs_plug.compat.ssim import fused_ssim


def rasterizer(family, **fields):
    return family.GaussianRasterizer(family.GaussianRasterizationSettings(**camera(), **fields))


# The positional order of each CUDA module.
ORDERS = {
    "inria": "bg scale_modifier viewmatrix projmatrix sh_degree campos prefiltered debug antialiasing",
    "fastgs": "bg scale_modifier viewmatrix projmatrix sh_degree campos mult prefiltered debug get_flag metric_map",
    "taming": "bg scale_modifier viewmatrix projmatrix sh_degree campos prefiltered debug pixel_weights",
    "lightgaussian": "bg scale_modifier viewmatrix projmatrix sh_degree campos prefiltered debug f_count",
    "mip_splatting": (
        "kernel_size subpixel_offset bg scale_modifier viewmatrix projmatrix sh_degree campos prefiltered debug"
    ),
    "pixel_gs": "bg scale_modifier depth_threshold viewmatrix projmatrix sh_degree campos prefiltered debug",
}


@pytest.mark.parametrize("family", ORDERS)
def test_settings_have_the_positional_order_of_the_cuda_module(family):
    module = importlib.import_module(f"skipgs_plug.compat.{family}")
    fields = ["image_height", "image_width", "tanfovx", "tanfovy", *ORDERS[family].split()]
    settings = module.GaussianRasterizationSettings(*fields)
    assert [getattr(settings, name) for name in fields] == fields == list(settings)


def test_fields_must_follow_a_base_field():
    with pytest.raises(ValueError, match=r"^No base field campus; expected one of image_height, "):
        settings_class({"campus": ("mult",)})


def test_inria_classic_returns_two_and_current_three():
    assert len(rasterizer(inria)(**gaussians())) == 2
    color, radii, inverse_depth = rasterizer(inria, antialiasing=False)(**gaussians())
    assert color.shape == (3, HEIGHT, WIDTH) and inverse_depth.shape == (1, HEIGHT, WIDTH)
    assert radii.dtype == torch.int32


def test_inrias_first_settings_have_no_debug():
    fields = {name: value for name, value in camera().items() if name != "debug"}  # as GaussianShader passes them
    assert inria.GaussianRasterizationSettings(**fields)[-2:] == (False, None)


def test_mark_visible_is_the_near_plane():
    view = camera()["viewmatrix"]
    points = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    depth = points @ view[:3, 2] + view[3, 2]
    assert rasterizer(inria).markVisible(points).tolist() == (depth > 0.2).tolist() == [True, False]


def test_fastgs_counts_pixels_of_the_metric_map():
    scene = gaussians()
    everywhere = torch.ones(HEIGHT * WIDTH, dtype=torch.int32)
    left_half = (torch.arange(HEIGHT * WIDTH) % WIDTH < WIDTH // 2).int()

    def counts(metric_map, get_flag):
        module = rasterizer(fastgs, mult=0.5, get_flag=get_flag, metric_map=metric_map)
        return module(**scene)[2]

    right = counts(everywhere - left_half, True)
    assert torch.equal(counts(left_half, True) + right, counts(everywhere, True))
    assert 0 < right.sum() < counts(everywhere, True).sum()
    assert counts(everywhere, None).shape == (0,)


def test_taming_returns_thirteen():
    scene = gaussians()
    weights = torch.rand(HEIGHT, WIDTH)
    result = rasterizer(taming, pixel_weights=weights)(**scene)
    assert len(result) == 13
    color, radii, counts, *_, centers, depths, same_radii, loss, count, blend, distance = result
    assert counts.shape == (HEIGHT, WIDTH) and counts.sum() == count.sum() > 0
    assert torch.equal(radii, same_radii) and centers.shape == (len(radii), 2)
    seen = count > 0
    assert (loss[seen] > 0).all() and (loss <= count).all() and (blend <= count).all()
    assert (distance <= count * radii * 1.2).all()
    doubled = rasterizer(taming, pixel_weights=2 * weights)(**scene)
    torch.testing.assert_close(doubled[9], 2 * loss)
    assert torch.equal(doubled[11], blend)
    plain = rasterizer(taming, pixel_weights=None)(**scene)
    assert torch.equal(plain[0], color) and [len(r) for r in plain[9:]] == [0, 0, 0, 0]
    torch.testing.assert_close(plain[7], depths)


def test_speedy_splat_sends_squares_into_the_scores():
    scene = gaussians()
    scores = torch.zeros(len(scene["means3D"]), 1, requires_grad=True)
    color, radii, times = rasterizer(speedy_splat)(**scene, scores=scores)
    color.sum().backward()
    assert scores.grad.shape == scores.shape and times.shape == (1,) and times.item() > 0
    drawn = scores.grad[radii > 0]
    assert (scores.grad >= 0).all() and (drawn > 0).float().mean() > 0.8
    assert len(drawn.unique()) > 0.8 * len(drawn)
    again = rasterizer(speedy_splat)(**scene, scores=scores)[0]
    scores.grad = None
    (3 * again.sum()).backward()
    torch.testing.assert_close(scores.grad[radii > 0], 9 * drawn, rtol=1e-4, atol=1e-8)


def test_speedy_splat_trains_without_scores():
    scene = gaussians()
    rasterizer(speedy_splat)(**scene, scores=None)[0].sum().backward()
    assert scene["means3D"].grad is not None


def test_lightgaussian_counts_and_scores():
    scene = gaussians()
    color, radii = rasterizer(lightgaussian, f_count=False)(**scene)
    assert color.requires_grad
    counts, score, counted_color, _ = rasterizer(lightgaussian, f_count=True)(**scene)
    assert torch.equal(counted_color, color) and not counted_color.requires_grad
    assert counts.dtype == torch.int32 and torch.equal(counts > 0, score > 0)
    assert (counts[radii == 0] == 0).all() and len(score.unique()) > len(score) // 2
    assert (score <= counts * scene["opacities"][:, 0] * (1 + 1e-5)).all()


def test_gaussianspa_returns_weights_areas_and_maxima():
    color, radii, weights, area, largest = rasterizer(gaussianspa)(**gaussians())
    assert color.requires_grad and (weights <= area).all() and (largest <= area).all()
    assert largest.sum() <= HEIGHT * WIDTH and largest.max() > 0
    assert (area[radii == 0] == 0).all()


def test_gaussianspa_depth_of_a_single_gaussian():
    view = camera()["viewmatrix"]
    center = (torch.tensor([0.0, 0.0, 2.0]) - view[3, :3]) @ torch.linalg.inv(view[:3, :3])
    scene = gaussians(4)
    scene = {name: value.detach()[:1] for name, value in scene.items()}
    scene |= {"means3D": center[None], "opacities": torch.tensor([[0.9]]), "scales": torch.full((1, 3), 0.05)}
    found = rasterizer(gaussianspa).render_depth(**scene)
    middle = (slice(None), HEIGHT // 2, WIDTH // 2)
    torch.testing.assert_close(found["rendered_depth"][middle], torch.tensor([2.0]), rtol=1e-2, atol=0)
    torch.testing.assert_close(found["out_pts"][middle], center, rtol=2e-2, atol=3e-2)
    assert found["gidx"][middle].item() == 0 and found["discriminants"][middle].item() > 0
    assert 0.05 < found["accum_alpha"][middle].item() < 0.3
    corner = (slice(None), 0, 0)
    assert found["accum_alpha"][corner].item() == 1 and found["rendered_depth"][corner].item() == 0
    assert found["render"].shape == found["out_pts"].shape == (3, HEIGHT, WIDTH)


def test_nearest_neighbours_are_those_of_brute_force():
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    distances = torch.cdist(points.double(), points.double()).square().fill_diagonal_(torch.inf)
    expected = distances.topk(3, largest=False).values.mean(1).float()
    torch.testing.assert_close(distCUDA2(points), expected)
    with pytest.raises(ValueError, match="at least 4"):
        distCUDA2(points[:3])


@pytest.mark.parametrize("padding", ["same", "valid"])
def test_ssim_of_equal_images_is_one_and_gradients_reach_the_first(padding):
    rng = torch.Generator().manual_seed(0)
    first, second = torch.rand(2, 1, 3, 20, 24, generator=rng)
    assert fused_ssim(first, first, padding=padding).item() == pytest.approx(1.0, abs=1e-5)
    first.requires_grad_(), second.requires_grad_()
    value = fused_ssim(first, second, padding=padding)
    value.backward()
    assert value < 0.5 and first.grad.abs().sum() > 0 and second.grad is None


def test_sparse_adam_moves_visible_rows_only():
    values = torch.randn(6, 2, 3, generator=torch.Generator().manual_seed(0))
    param = torch.nn.Parameter(values.clone())
    other = torch.nn.Parameter(torch.ones(6, 1))
    optimizer = SparseGaussianAdam([{"params": [param]}, {"params": [other]}], lr=0.1, eps=1e-15)
    visible = torch.tensor([True, False, True, False, False, True])
    for _ in range(2):
        param.grad = torch.full_like(param, 0.5)
        optimizer.step(visible, 6)
    # Two steps without bias correction: 0.1 g / sqrt(0.001 g^2), then 0.19 g / sqrt(0.001999 g^2).
    moved = 0.1 * (0.1 / 0.001**0.5 + 0.19 / 0.001999**0.5)
    torch.testing.assert_close(param.data[visible], values[visible] - moved)
    assert torch.equal(param.data[~visible], values[~visible])
    assert (other == 1).all()


@pytest.mark.parametrize("family", sorted(name for name in FAMILIES if FAMILIES[name]))
def test_modules_are_served_and_taken_away(family):
    other_module = object()
    names = list(FAMILIES[family])
    before = set(sys.modules)
    sys.modules[names[0]] = other_module  # modules from before are restored
    try:
        with serve(family):
            for name, (_, offered) in FAMILIES[family].items():
                assert all(hasattr(importlib.import_module(name), attribute) for attribute in offered)
                assert importlib.util.find_spec(name) is not None  # how a script asks whether an extension is there
        assert sys.modules[names[0]] is other_module
    finally:
        del sys.modules[names[0]]
    left = {name for name in set(sys.modules) - before if not name.startswith("skipgs_plug.")}
    assert not left & (set(names) | {"torchvision"})


def test_unknown_family_is_named():
    with pytest.raises(ValueError, match=r"'nerf'.*taming"), serve("nerf"):
        pass


@pytest.mark.skipif(importlib.util.find_spec("torchvision") is not None, reason="torchvision is installed")
def test_missing_torchvision_is_stood_in_for(tmp_path):
    from PIL import Image

    with serve("taming"):
        import torchvision
        import torchvision.transforms as transforms

        find_spec = importlib.util.find_spec
        assert find_spec("torchvision") is None  # else torchmetrics imports models of it, or fails on import
        picture = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0))
        torchvision.utils.save_image(picture, tmp_path / "a.png")
        back = transforms.functional.to_tensor(Image.open(tmp_path / "a.png"))
        assert (back - picture).abs().max() <= 0.5 / 255 + 1e-6
        for depth in (picture[:1], picture[0]):  # Spec-Gaussian saves its depths
            torchvision.utils.save_image(depth, tmp_path / "depth.png")
            assert (transforms.functional.to_tensor(Image.open(tmp_path / "depth.png")) == back[:1]).all()
        gray = transforms.ToTensor()(transforms.ToPILImage()(picture).convert("L"))
        assert gray.shape == (1, 5, 7)
        from lpips.lpips import LPIPS  # Deblurring-3DGS asks for the package's inner module
        from lpipsPyTorch import lpips

        with pytest.warns(UserWarning, match="LPIPS needs torchvision"):  # an evaluation must not end the run
            assert LPIPS()(picture, picture).isnan()
            assert lpips(picture, picture, net_type="vgg").isnan()
            assert lpips(picture, picture, None, net_type="vgg").isnan()  # FSGS passes a mask
    assert find_spec is not importlib.util.find_spec and find_spec("json") == importlib.util.find_spec("json")


def test_mip_splatting_filters_conserve_opacity_and_sum_absolute_gradients():
    scene = gaussians()
    offset = torch.zeros(HEIGHT, WIDTH, 2)
    color, radii = rasterizer(mip_splatting, kernel_size=0.1, subpixel_offset=offset)(**scene)
    with torch.no_grad():
        expected, _ = oracle(scene, camera(), intrinsics(), rasterize_mode="antialiased", eps2d=0.1)
    torch.testing.assert_close(color.double(), expected, rtol=2e-3, atol=2e-5)
    color.square().sum().backward()
    gradient = scene["means2D"].grad
    assert (gradient[:, 2] >= gradient[:, :2].abs().sum(dim=1) * (1 - 1e-4)).all() and (
        gradient[radii > 0, 2] > 0
    ).all()
    with pytest.raises(NotImplementedError, match="without --ray_jitter"):
        rasterizer(mip_splatting, kernel_size=0.1, subpixel_offset=offset + 0.5)(**scene)


def test_absgs_sums_blend_weights():
    scene = gaussians() | {"means2D": torch.zeros(30, 4, requires_grad=True)}
    color, radii, weight = rasterizer(absgs)(**scene)
    _, _, expected, area, _ = rasterizer(gaussianspa)(**scene)
    torch.testing.assert_close(weight, expected)
    color.sum().backward()
    assert (weight <= area).all() and (scene["means2D"].grad[radii > 0, 2:] > 0).all()


def test_pixel_gs_counts_pixels_and_fades_near_gradients():
    def gradients(threshold):
        scene = gaussians()
        color, _, pixels = rasterizer(pixel_gs, depth_threshold=threshold)(**scene)
        color.square().sum().backward()
        return scene, pixels, scene["means2D"].grad

    scene, pixels, whole = gradients(1e-3)
    _, _, faded = gradients(3.0)
    depth = scene["means3D"].detach() @ camera()["viewmatrix"][:3, 2] + camera()["viewmatrix"][3, 2]
    torch.testing.assert_close(faded, whole * (depth / 3.0).square().clamp_max(1.0)[:, None])
    assert not torch.equal(faded, whole) and torch.equal(whole, gradients(None)[2])
    assert torch.equal(pixels[:, 0], rasterizer(gaussianspa)(**gaussians())[3].float())


def test_improved_gs_weights_are_linear_in_the_picture():
    scene = gaussians() | {"means2D": torch.zeros(30, 4, requires_grad=True)}
    ones = rasterizer(improved_gs, pixel_weights=torch.ones(HEIGHT, WIDTH))(**scene)
    assert len(ones) == 13 and len(rasterizer(improved_gs, pixel_weights=None)(**scene)[9]) == 0
    torch.testing.assert_close(ones[9], rasterizer(absgs)(**scene)[2])
    left = (torch.arange(WIDTH) < WIDTH // 2).float().expand(HEIGHT, WIDTH)
    halves = [rasterizer(improved_gs, pixel_weights=w)(**scene)[9] for w in (left, 1 - left)]
    torch.testing.assert_close(halves[0] + halves[1], ones[9])


def test_mcmc_marks_what_is_drawn_and_relocates_unchanged_pictures():
    color, radii, used = rasterizer(mcmc)(**gaussians())
    assert color.requires_grad and torch.equal(used, (radii > 0).int()) and used.any()
    binoms = torch.tensor([[math.comb(n, k) for k in range(51)] for n in range(51)], dtype=torch.float32)
    opacity, scale = torch.tensor([0.3, 0.8]), torch.rand(2, 3)
    same = mcmc.compute_relocation(opacity, scale, torch.tensor([1, 1]), binoms, 51)
    torch.testing.assert_close(same, (opacity, scale))
    shared, smaller = mcmc.compute_relocation(opacity, scale, torch.tensor([2, 3]), binoms, 51)
    torch.testing.assert_close((1 - shared) ** torch.tensor([2, 3]), 1 - opacity)
    assert (smaller < scale).all()


def test_scaffold_gs_filters_anchors_and_takes_maxima():
    scene = {name: gaussians()[name] for name in ("means3D", "scales", "rotations")}
    module = rasterizer(scaffold_gs)
    found = module.visible_filter(**scene)
    assert torch.equal(found > 0, module(**gaussians() | {"opacities": torch.ones(30, 1)})[1] > 0)
    assert (module.visible_filter(scene["means3D"] - 100, scene["scales"], scene["rotations"]) == 0).all()
    values = torch.tensor([[1.0, -4.0], [3.0, -2.0], [-5.0, -9.0]])
    groups = torch.tensor([0, 0, 2])[:, None].expand(-1, 2)
    largest, _ = scaffold_gs.scatter_max(values, groups, dim=0)
    assert torch.equal(largest[[0, 2]], torch.tensor([[3.0, -2.0], [-5.0, -9.0]]))


@pytest.mark.skipif(shutil.which("nvidia-smi") is not None, reason="there is an nvidia-smi")
def test_scaffold_gs_is_told_of_one_free_gpu():
    ask = "nvidia-smi -q -d Memory | grep -A4 GPU | grep Used"
    before = os.environ["PATH"]
    with serve("scaffold_gs"):
        answer = subprocess.run(ask, shell=True, capture_output=True, text=True, check=True).stdout
    assert [int(line.split()[2]) for line in answer.splitlines()] == [0] and os.environ["PATH"] == before
