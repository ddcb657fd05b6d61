"""Load, export, load: every format into every other one, within the rounding of the one that was written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from skipgs_plug.cli import main
from skipgs_plug.trainer.ply import PROPERTIES, read_ply, write_ply
from skipgs_plug.view.model import open_model, open_snapshots
from skipgs_plug.view.spz import to_spz

FORMATS = (".ply", ".compressed.ply", ".splat", ".spz")
N = 300
Splats = dict[str, torch.Tensor]


@pytest.fixture(scope="module")
def splats() -> Splats:
    generator = torch.Generator().manual_seed(3)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    return {
        "means": torch.randn(N, 3, generator=generator),
        "scales": uniform(-7, -2, N, 3),
        "quats": torch.nn.functional.normalize(torch.randn(N, 4, generator=generator), dim=1),
        "opacities": uniform(-4, 4, N),
        "sh0": uniform(-1.7, 1.7, N, 1, 3),
        "shN": uniform(-0.9, 0.9, N, 15, 3),
    }


@pytest.fixture(scope="module")
def sources(splats: Splats, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One file of each format, and a run folder with a checkpoint alone."""
    folder = tmp_path_factory.mktemp("sources")
    write_ply(splats, folder / "model.ply")
    run = folder / "run/ckpts"
    run.mkdir(parents=True)
    torch.save({"splats": splats, "scene": {"centre": [0.0, 0.0, 0.0], "unit": 1.0}}, run / "ckpt_9_rank0.pt")
    result = {"checkpoint": folder / "run", ".ply": folder / "model.ply"}
    for ending in FORMATS[1:]:
        result[ending] = folder / f"model{ending}"
        assert main(["export", str(folder / "model.ply"), str(result[ending])]) == 0
    return result


def load(path: Path) -> Splats:
    return open_snapshots(path)[-1].load()


def partners(first: Splats, second: Splats) -> torch.Tensor:
    """Return the row of `first` that each of `second` is: formats sort Gaussians by their place."""
    rows = torch.cdist(second["means"].double(), first["means"].double()).argmin(dim=1)
    assert sorted(rows.tolist()) == list(range(N))
    return rows


def check(written: Splats, read: Splats, ending: str) -> None:
    rows = partners(written, read)
    expected = {name: values[rows] for name, values in written.items()}
    if ending == ".ply":
        for name in ("means", "scales", "quats", "opacities", "sh0"):
            assert torch.equal(read[name], expected[name]), name
        k = expected["shN"].shape[1]
        assert torch.equal(read["shN"][:, :k], expected["shN"])
        assert not read["shN"][:, k:].any()
        return
    rounding = {  # errors of positions, logarithms of scales, opacities, colours, harmonics
        ".compressed.ply": (0.01, 0.01, 0.003, 0.03, 0.04),
        ".splat": (0.0, 1e-5, 0.005, 0.015, None),
        ".spz": (1e-6, 0.04, 0.003, 0.02, 0.07),
    }[ending]
    differences = {
        "means": read["means"] - expected["means"],
        "scales": read["scales"] - expected["scales"],
        "opacities": torch.sigmoid(read["opacities"]) - torch.sigmoid(expected["opacities"]),
        "sh0": read["sh0"] - expected["sh0"],
    }
    if rounding[4] is None:
        assert read["shN"].shape[1] == 0
    else:
        differences["shN"] = read["shN"] - expected["shN"]
    for (name, difference), bound in zip(differences.items(), rounding, strict=False):
        assert difference.numel() == 0 or float(difference.abs().max()) <= bound, name
    quats = (torch.nn.functional.normalize(values["quats"], dim=1) for values in (read, expected))
    # The third of a unit that a byte holds; .spz works the fourth part out of three.
    assert float((next(quats) * next(quats)).sum(dim=1).abs().min()) > (0.98 if ending == ".spz" else 0.999)


@pytest.mark.parametrize("target", FORMATS)
@pytest.mark.parametrize("source", ["checkpoint", *FORMATS])
def test_every_pair_of_formats(sources: dict[str, Path], tmp_path: Path, source: str, target: str) -> None:
    first = load(sources[source])
    assert main(["export", str(sources[source]), str(tmp_path / f"out{target}")]) == 0
    second = load(tmp_path / f"out{target}")
    check(first, second, target)
    if source == target != ".splat":  # gsplat truncates where others round
        for name in first:
            torch.testing.assert_close(
                second[name].abs(), first[name][partners(first, second)].abs(), rtol=0, atol=0.01
            )


ORDERS = st.permutations([name for name in PROPERTIES if name[0] != "n"])


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    order=ORDERS,
    kinds=st.lists(st.sampled_from(["f4", "f8"]), min_size=59, max_size=59),
    form=st.sampled_from(["<", ">", "text"]),
    extra=st.sampled_from([(), ("nx", "ny", "nz"), ("red", "confidence")]),
)
def test_any_order_and_type_of_columns(splats: Splats, tmp_path: Path, order, kinds, form: str, extra) -> None:
    write_ply(splats, tmp_path / "model.ply")
    vertices = PlyData.read(tmp_path / "model.ply")["vertex"].data
    columns = [*zip(order, kinds, strict=True), *((name, "u1") for name in extra)]
    rows = np.empty(N, dtype=columns)
    for name, _ in columns:
        rows[name] = vertices[name] if name in PROPERTIES else 7
    text = form == "text"
    data = PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order="=" if text else form)
    data.write(str(tmp_path / "other.ply"))
    read = read_ply(tmp_path / "other.ply")
    for name, values in splats.items():
        if text:  # written with as many digits as plyfile finds fit
            torch.testing.assert_close(read[name], values, rtol=1e-6, atol=1e-9)
        else:
            assert torch.equal(read[name], values), name


def test_scales_that_spz_does_not_hold_are_counted(splats: Splats, caplog: pytest.LogCaptureFixture) -> None:
    to_spz(splats)
    assert not caplog.text
    scales = splats["scales"].clone()
    scales[:7, 1] -= 9  # scales of a scene in kilometres
    scales[7:9] += 13
    to_spz({**splats, "scales": scales})
    assert "the scales of 9 Gaussians are cut" in caplog.text


def test_antialiasing_travels_with_an_spz(splats: Splats, tmp_path: Path) -> None:
    """It changes how opacities are to be drawn."""
    run = tmp_path / "run"
    (run / "ckpts").mkdir(parents=True)
    torch.save({"splats": splats}, run / "ckpts/ckpt_9_rank0.pt")
    for value in (False, True):
        (run / "cfg.yml").write_text(f"antialiased: {str(value).lower()}\n")
        assert main(["export", str(run), str(tmp_path / "one.spz")]) == 0
        assert open_model(tmp_path / "one.spz").antialiased is value
        assert main(["export", str(tmp_path / "one.spz"), str(tmp_path / "two.spz")]) == 0
        assert open_model(tmp_path / "two.spz").antialiased is value
