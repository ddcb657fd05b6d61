"""SOG files, decoded by hand as their specification says."""

from __future__ import annotations

import io
import json
import zipfile
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from skipgs_plug.cli import main
from skipgs_plug.trainer.ply import read_ply
from skipgs_plug.view.sog import position_error, to_sog


def decode(data: bytes) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())
        meta = json.loads(archive.read("meta.json"))

        def pixels(part: str, i: int = 0, channels: int = 3) -> np.ndarray:
            with Image.open(io.BytesIO(archive.read(meta[part]["files"][i]))) as picture:
                assert picture.format == "WEBP"
                return np.asarray(picture.convert("RGBA")).reshape(-1, 4)[:, :channels]

        def rows(*arguments: Any) -> np.ndarray:
            return pixels(*arguments)[: meta["count"]]

        assert meta["version"] == 2
        low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
        bits = rows("means", 0).astype(int) + 256 * rows("means", 1).astype(int)
        logarithms = low + (high - low) * bits / 65535
        four = rows("quats", 0, 4).astype(int)
        quats = np.zeros((meta["count"], 4))
        for i, (*smaller, largest) in enumerate(four):
            parts = [(2 * byte / 255 - 1) / np.sqrt(2) for byte in smaller]
            parts.insert(largest - 252, np.sqrt(max(0.0, 1 - sum(part**2 for part in parts))))
            quats[i] = parts
        colours = rows("sh0", 0, 4)
        found = {
            "means": np.sign(logarithms) * (np.exp(np.abs(logarithms)) - 1),
            "scales": np.array(meta["scales"]["codebook"])[rows("scales")],
            "quats": quats,
            "sh0": np.array(meta["sh0"]["codebook"])[colours[:, :3]],
            "opacities": colours[:, 3] / 255,
        }
        if "shN" in meta:
            coefficients = (meta["shN"]["bands"] + 1) ** 2 - 1
            palette = pixels("shN").reshape(-1, coefficients, 3)  # a row of the picture holds 64 entries
            assert len(palette) % 64 == 0 and len(palette) - 64 < meta["shN"]["count"] <= len(palette)
            with Image.open(io.BytesIO(archive.read(meta["shN"]["files"][0]))) as picture:
                assert picture.width == 64 * coefficients
            labels = rows("shN", 1).astype(int)
            assert (labels[:, 2] == 0).all()
            found["shN"] = np.array(meta["shN"]["codebook"])[palette[labels[:, 0] + 256 * labels[:, 1]]]
    return found


def in_order(rows: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Return which of `means` lies nearest to each of `rows`; each serves once."""
    nearest = ((rows[:, None] - means[None]) ** 2).sum(axis=2).argmin(axis=1)
    assert len(set(nearest.tolist())) == len(rows)
    return nearest


def model(n: int, k: int, size: float = 1.0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(k)
    return {
        "means": size * torch.randn(n, 3, generator=generator),
        "quats": 3 * torch.randn(n, 4, generator=generator),
        "scales": torch.rand(n, 3, generator=generator) * 6 - 8,
        "opacities": 2 * torch.randn(n, generator=generator),
        "sh0": torch.randn(n, 1, 3, generator=generator),
        "shN": torch.randint(-2, 3, (n, 1, 3), generator=generator).expand(n, k, 3) / 8,
    }


@pytest.mark.parametrize(("k", "size"), [(0, 1e-2), (3, 1.0), (8, 40.0), (15, 1e4)])
def test_what_is_read_back_is_what_was_written(k: int, size: float) -> None:
    splats = model(300, k, size)
    read = decode(to_sog(splats))
    order = in_order(read["means"], splats["means"].numpy())
    wanted = {name: tensor.numpy()[order] for name, tensor in splats.items()}
    scaled = np.log1p(np.abs(wanted["means"]))
    step = 2 * scaled.max() / 65535
    assert (np.abs(read["means"] - wanted["means"]) <= 0.51 * step * np.exp(scaled + step)).all()
    for name, rows in (("scales", wanted["scales"]), ("sh0", wanted["sh0"][:, 0])):
        error = np.abs(read[name] - rows)  # 900 numbers share 256 levels, which are dense where numbers are
        assert error.max() < 0.1 and np.sqrt((error**2).mean()) < 0.01
    assert np.abs(read["opacities"] - 1 / (1 + np.exp(-wanted["opacities"]))).max() <= 0.51 / 255
    quats = wanted["quats"] / np.linalg.norm(wanted["quats"], axis=1, keepdims=True)
    assert np.abs((read["quats"] * quats).sum(axis=1)).min() > 0.9999
    if k:
        # There are 37 entries for up to 125 different rows. Each row is near its entry.
        error = np.sqrt(((read["shN"] - wanted["shN"]) ** 2).mean())
        assert error < 0.6 * np.sqrt((wanted["shN"] ** 2).mean())
    else:
        assert "shN" not in read


def test_a_palette_that_can_hold_every_row_does() -> None:
    splats = model(4000, 15)
    splats["shN"] = splats["shN"][:20].repeat(200, 1, 1)
    read = decode(to_sog(splats))
    order = in_order(read["means"], splats["means"].numpy())
    assert np.abs(read["shN"] - splats["shN"].numpy()[order]).max() < 1e-6


def test_models_far_from_the_origin_keep_their_shape() -> None:
    splats = model(200, 0)
    splats["means"] = splats["means"].double() + torch.tensor([4e6, -5e5, 30.0], dtype=torch.float64)
    read = decode(to_sog(splats, antialiased=True))
    order = in_order(read["means"], splats["means"].numpy())
    error = np.abs(read["means"] - splats["means"].numpy()[order]).max()
    assert error <= position_error(splats["means"]) < 2e-4


def test_viewers_are_told_of_antialiasing() -> None:
    for antialiased in (False, True):
        with zipfile.ZipFile(io.BytesIO(to_sog(model(5, 0), antialiased))) as archive:
            meta = json.loads(archive.read("meta.json"))
        assert meta.get("model") == ("antialiased" if antialiased else None)


def test_a_model_without_extent_is_written() -> None:
    splats = model(1, 15)
    splats["means"][:] = 0
    read = decode(to_sog(splats))
    assert (read["means"] == 0).all() and np.abs(read["shN"] - splats["shN"].numpy()).max() < 1e-6


def test_the_command_writes_it(ply, tmp_path, capsys) -> None:
    out = tmp_path / "model.sog"
    assert main(["export", str(ply), str(out)]) == 0
    assert f"{len(read_ply(ply)['means']):,} Gaussians" in capsys.readouterr().out
    assert len(decode(out.read_bytes())["means"]) == len(read_ply(ply)["means"])
