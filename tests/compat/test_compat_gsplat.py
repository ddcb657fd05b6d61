"""The functions that replace gsplat's CUDA functions in its own training script."""

import importlib
import math
import sys

import pytest
import torch

pytest.importorskip("gsplat")

from skipgs_plug.compat import serve
from skipgs_plug.compat.relocation import compute_relocation
from skipgs_plug.compat.strategy_operations import quat_scale_to_covar_preci
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.fallback_raster import rasterization


def binomials(n_max):
    return torch.tensor([[float(math.comb(n, k)) for k in range(n_max)] for n in range(n_max)])


def test_relocation_is_equation_nine():
    opacities, scales = torch.tensor([0.3, 0.9, 0.6]), torch.rand(3, 3)
    new_opacities, new_scales = compute_relocation(opacities, scales, torch.tensor([1, 2, 70]), binomials(51))
    for row, copies in enumerate((1, 2, 51)):
        opacity = 1 - (1 - opacities[row].item()) ** (1 / copies)
        total = sum(
            math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * opacity ** (k + 1)
            for i in range(1, copies + 1)
            for k in range(i)
        )
        assert new_opacities[row].item() == pytest.approx(opacity, rel=1e-4)
        factor = new_scales[row] / scales[row]
        assert factor.tolist() == pytest.approx([opacities[row].item() / total] * 3, rel=1e-2)
    torch.testing.assert_close(new_scales[0], scales[0])
    column, scales_of_column = compute_relocation(opacities[:, None], scales, torch.tensor([1, 2, 70]), binomials(51))
    assert torch.equal(column[:, 0], new_opacities) and torch.equal(scales_of_column, new_scales)


def test_relocation_keeps_opacities_visible():
    opacities, scales, twice = torch.tensor([0.004, 0.8]), torch.ones(2, 3), torch.tensor([2, 2])
    free, _ = compute_relocation(opacities, scales, twice, binomials(51))
    kept, grown = compute_relocation(opacities, scales, twice, binomials(51), min_opacity=0.005)
    assert free[0] < 0.005 and kept.tolist() == [pytest.approx(0.005), free[1].item()]
    # Equation 9 for two copies of opacity a: 2 a - a^2 / sqrt(2).
    assert grown[0, 0].item() == pytest.approx(0.004 / (2 * 0.005 - 0.005**2 / math.sqrt(2)), rel=1e-4)


def test_covariance_and_precision_are_gsplats_own_formula():
    from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

    rng = torch.Generator().manual_seed(0)
    quats, scales = torch.randn(5, 4, generator=rng), torch.rand(5, 3, generator=rng) + 0.1
    ours, theirs = quat_scale_to_covar_preci(quats, scales), _quat_scale_to_covar_preci(quats, scales)
    torch.testing.assert_close(ours, theirs)
    assert quat_scale_to_covar_preci(quats, scales, compute_preci=False)[1] is None


def test_gsplat_is_replaced_for_the_block_only():
    import gsplat.rendering
    import gsplat.strategy.ops

    before = (gsplat.rendering.rasterization, gsplat.strategy.ops.compute_relocation)
    with serve("gsplat"):
        assert gsplat.rendering.rasterization.__wrapped__ is rasterization
        assert gsplat.strategy.ops.compute_relocation is compute_relocation
    assert (gsplat.rendering.rasterization, gsplat.strategy.ops.compute_relocation) == before


def test_a_forks_own_gsplat_that_lacks_a_package_is_no_missing_extra(monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "gsplat"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch.nn.functional", None)  # gsplat imports it
    refused = pytest.raises(SkipGSError, match=r"gsplat cannot be imported \(.*functional.*install what it needs")
    with refused, serve("gsplat"):
        pass


def test_nerfstudio_gets_what_its_pinned_gsplat_returned(monkeypatch):
    import gsplat.rendering

    monkeypatch.setattr(gsplat, "__version__", "1.4.0")
    scene = {
        "means": torch.tensor([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2),
        "scales": torch.full((2, 3), 0.1),
        "opacities": torch.tensor([0.5, 0.9]),
        "colors": torch.rand(2, 3),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[20.0, 0.0, 8.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]]]),
        "width": 16,
        "height": 16,
    }
    expected, _, info = rasterization(**scene, packed=False)
    with serve("nerfstudio"):
        importlib.import_module("torchvision.utils")  # nerfstudio saves pictures with it
        image, _, old = gsplat.rendering.rasterization(**scene, packed=False)
    assert torch.equal(image, expected)
    assert old["radii"].shape == (1, 2) and torch.equal(old["radii"], info["radii"].amax(dim=-1))
    assert gsplat.rendering.rasterization is not rasterization
