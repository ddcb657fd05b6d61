"""SPZ files, decoded by hand as their description says."""

from __future__ import annotations

import gzip
import struct

import numpy as np
import pytest
import torch

from skipgs_plug.cli import main
from skipgs_plug.fallback_raster.oracle.torch_reference_projection import spherical_harmonics
from skipgs_plug.trainer import InputError
from skipgs_plug.trainer.ply import read_ply
from skipgs_plug.view import spz
from skipgs_plug.view.spz import position_error, to_spz

FLIP = np.array([1.0, -1.0, -1.0])


def decode(data: bytes) -> dict[str, np.ndarray]:
    content = gzip.decompress(data)
    magic, version, n, degree, bits, flags, _ = struct.unpack_from("<IIIBBBB", content)
    assert (magic, version, flags) == (0x5053474E, 2, 0)
    k = (degree + 1) ** 2 - 1
    raw = np.frombuffer(content, np.uint8, offset=16)
    sizes = {"means": 9, "opacities": 1, "sh0": 3, "scales": 3, "quats": 3, "shN": 3 * k}
    parts = dict(zip(sizes, np.split(raw, np.cumsum(list(sizes.values())) * n), strict=False))
    assert len(raw) == sum(sizes.values()) * n
    whole = parts["means"].reshape(n, 3, 3).astype(np.int64) @ np.array([1, 256, 65536])
    xyz = parts["quats"].reshape(n, 3) / 127.5 - 1
    return {
        "means": np.where(whole >= 2**23, whole - 2**24, whole) / 2.0**bits,
        "opacities": parts["opacities"] / 255,
        "sh0": (parts["sh0"].reshape(n, 3) / 255 - 0.5) / 0.15,
        "scales": parts["scales"].reshape(n, 3) / 16 - 10,
        "quats": np.concatenate([np.sqrt((1 - (xyz**2).sum(1, keepdims=True)).clip(0)), xyz], axis=1),
        "shN": (parts["shN"].reshape(n, k, 3).astype(float) - 128) / 128,
    }


@pytest.mark.parametrize(("k", "size"), [(0, 1e-3), (3, 1.0), (8, 40.0), (15, 1e5)])
def test_what_is_read_back_is_what_was_written(k: int, size: float) -> None:
    generator = torch.Generator().manual_seed(k)
    n = 50
    splats = {
        "means": size * torch.randn(n, 3, generator=generator),
        "quats": 3 * torch.randn(n, 4, generator=generator),
        "scales": torch.rand(n, 3, generator=generator) * 6 - 8,
        "opacities": 2 * torch.randn(n, generator=generator),
        "sh0": torch.randn(n, 1, 3, generator=generator),
        "shN": torch.rand(n, k, 3, generator=generator) - 0.5,
    }
    read = decode(to_spz(splats))
    largest = float(splats["means"].abs().max())
    assert np.abs(read["means"] * FLIP - splats["means"].numpy()).max() <= max(largest * 2**-22, 2**-24)
    assert np.abs(read["opacities"] - torch.sigmoid(splats["opacities"]).numpy()).max() <= 0.51 / 255
    assert np.abs(read["scales"] - splats["scales"].numpy()).max() <= 0.51 / 16
    visible = splats["sh0"][:, 0].numpy().clip(-0.5 / 0.15, 0.5 / 0.15)
    assert np.abs(read["sh0"] - visible).max() <= 0.51 / 255 / 0.15
    quats = torch.nn.functional.normalize(splats["quats"], dim=1).numpy()
    turned = read["quats"] * (1, *FLIP)
    assert (
        np.abs((turned * quats).sum(axis=1)).min() > 0.99
    )  # w follows from the length 1, so it is coarse near half a turn


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_the_largest_coordinates_are_kept_and_larger_ones_refused(kind: torch.dtype) -> None:
    splats = grey_at(torch.tensor([[8_388_607.0, -8_388_607.0, 1.0]], dtype=kind))
    assert np.array_equal(decode(to_spz(splats))["means"] * FLIP, splats["means"].numpy())
    for axis in range(3):
        splats["means"][0, axis] = -8_388_608.0
        with pytest.raises(InputError, match=r"up to 8,388,607, .* has 8,388,608; write a \.ply or a \.sog"):
            to_spz(splats)
        splats["means"][0, axis] = 1.0


def test_more_gaussians_than_readers_take_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spz, "MOST", 3)
    to_spz(grey_at(torch.rand(3, 3)))
    with pytest.raises(InputError, match=r"holds 3 Gaussians, and this model has 4; write a \.ply or a \.sog"):
        to_spz(grey_at(torch.rand(4, 3)))


@pytest.mark.parametrize("largest", [1e-3, 0.7, 129.0, 4_500_000.0])
def test_the_stated_error_bounds_the_rounding(largest: float) -> None:
    means = largest * (2 * torch.rand(500, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 1)
    error = np.abs(decode(to_spz(grey_at(means)))["means"] * FLIP - means.numpy()).max()
    assert 0.9 * position_error(means) < error <= position_error(means)


def grey_at(means: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the raw parameters of grey Gaussians at these positions [N, 3]."""
    n = len(means)
    splats = {"means": means, "quats": torch.ones(n, 4), "scales": torch.zeros(n, 3), "opacities": torch.zeros(n)}
    return {**splats, "sh0": torch.zeros(n, 1, 3), "shN": torch.zeros(n, 0, 3)}


def test_directions_turn_with_the_axes() -> None:
    """A colour seen along a direction is the one of the turned coefficients seen along the turned direction."""
    generator = torch.Generator().manual_seed(1)
    n = 40
    rest = torch.randint(-3, 4, (n, 15, 3), generator=generator) / 8  # four bits hold these exactly
    splats = {
        "means": torch.zeros(n, 3),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        "scales": torch.zeros(n, 3),
        "opacities": torch.zeros(n),
        "sh0": torch.zeros(n, 1, 3),
        "shN": rest,
    }
    read = torch.from_numpy(decode(to_spz(splats))["shN"])
    directions = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=1)
    zeros = torch.zeros(n, 1, 3, dtype=torch.float64)
    before = spherical_harmonics(3, directions, torch.cat([zeros, rest.double()], dim=1))
    after = spherical_harmonics(3, directions * torch.from_numpy(FLIP), torch.cat([zeros, read], dim=1))
    torch.testing.assert_close(after, before)


def test_the_command_writes_it(ply, tmp_path) -> None:
    assert main(["export", str(ply), str(tmp_path / "model.spz")]) == 0
    read = decode((tmp_path / "model.spz").read_bytes())
    assert len(read["means"]) == len(read_ply(ply)["means"])
