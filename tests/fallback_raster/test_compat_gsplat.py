"""The functions that stand in for gsplat's CUDA ones in its own training script."""

import math

import pytest
import torch

pytest.importorskip("gsplat")

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.compat import serve
from skipgs_plug.fallback_raster.compat.gsplat_script import compute_relocation, quat_scale_to_covar_preci


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
        assert gsplat.rendering.rasterization is rasterization
        assert gsplat.strategy.ops.compute_relocation is compute_relocation
    assert (gsplat.rendering.rasterization, gsplat.strategy.ops.compute_relocation) == before
