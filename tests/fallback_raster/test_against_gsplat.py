"""The reference against gsplat's own PyTorch functions, which run on the CPU."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from raster_scenes import leaves, random_scene

from skipgs_plug.fallback_raster.oracle import torch_reference
from skipgs_plug.fallback_raster.oracle import torch_reference_projection as projection

gsplat_torch: Any = pytest.importorskip("gsplat.cuda._torch_impl")


def test_rotation_and_covariance() -> None:
    scene = leaves(random_scene(), torch.float64)
    covariances, _ = gsplat_torch._quat_scale_to_covar_preci(scene["quats"], scene["scales"], True, False)
    axes = projection.rotation_matrices(scene["quats"]) * scene["scales"][:, None, :]
    torch.testing.assert_close(axes @ axes.transpose(-1, -2), covariances, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("degree", range(4))
def test_spherical_harmonics(degree: int) -> None:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    coeffs = torch.randn(50, 16, 3, generator=generator, dtype=torch.float64)
    ours = projection.spherical_harmonics(degree, directions, coeffs)
    theirs = gsplat_torch._spherical_harmonics(degree, directions, coeffs)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("antialiased", [False, True])
def test_projection_and_its_gradients(antialiased: bool) -> None:
    """gsplat's PyTorch projection ignores opacity: its boxes reach 3.33 sigma, as ours do for opacities of 1."""
    scene = random_scene(cameras=3, n=500)
    scene["opacities"] = torch.full_like(scene["opacities"], 1.0 if antialiased else 1.1)
    results = []
    for ours in (True, False):
        inputs = leaves(scene, torch.float64, ("viewmats",))
        if ours:
            _, _, info = torch_reference.rasterization_reference(
                **inputs, packed=False, rasterize_mode="antialiased" if antialiased else "classic"
            )
            outputs = [info[name] for name in ("means2d", "depths", "conics", "opacities")]
            seen = (info["radii"] > 0).all(dim=-1)
            radii = info["radii"]
        else:
            covariances, _ = gsplat_torch._quat_scale_to_covar_preci(inputs["quats"], inputs["scales"])
            radii, *outputs = gsplat_torch._fully_fused_projection(
                inputs["means"],
                covariances,
                inputs["viewmats"],
                inputs["Ks"],
                inputs["width"],
                inputs["height"],
                calc_compensations=antialiased,
            )
            outputs[3] = torch.ones_like(outputs[1]) if outputs[3] is None else outputs[3]
        rows = [t[seen] for t in outputs]
        generator = torch.Generator().manual_seed(1)
        upstream = [torch.randn(t.shape, generator=generator, dtype=torch.float64) for t in rows]
        if not antialiased:
            rows, upstream = rows[:3], upstream[:3]
        torch.autograd.backward(rows, upstream)
        names = ("means", "quats", "scales", "viewmats")
        results.append([*rows, *(inputs[name].grad for name in names)])
        if not antialiased:
            results[-1].append(radii)
    assert seen.any() and not seen.all()
    for ours_value, theirs_value in zip(*results, strict=True):
        torch.testing.assert_close(ours_value, theirs_value, rtol=1e-9, atol=1e-10)


def test_tiles() -> None:
    scene = leaves(random_scene(cameras=2, n=80), torch.float32)
    _, _, info = torch_reference.rasterization_reference(**scene, packed=False)
    names = ("tiles_per_gauss", "isect_ids", "flatten_ids")
    size = info["tile_size"], info["tile_width"], info["tile_height"]
    theirs = gsplat_torch._isect_tiles(info["means2d"], info["radii"], info["depths"], *size)
    for name, value in zip(names, theirs, strict=True):
        assert torch.equal(info[name], value), name
    offsets = gsplat_torch._isect_offset_encode(theirs[1], info["n_cameras"], *size[1:])
    assert torch.equal(info["isect_offsets"], offsets)
