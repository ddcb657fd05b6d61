"""The public page in a real browser, at the widths of a phone and a desktop, and its files."""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import Browser, wait_until
from PIL import Image
from scipy.spatial.transform import Rotation

from skipgs_plug.commands.view import Draw
from skipgs_plug.fallback_raster.oracle.torch_reference_projection import spherical_harmonics
from skipgs_plug.trainer.backend import resolve_backend
from skipgs_plug.view.model import open_model
from skipgs_plug.view.web.rotate_model import rotated, rotated_harmonics, upright
from skipgs_plug.view.web.server import WebPage

pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def page(run_folder: Path) -> Iterator[WebPage]:
    model = open_model(run_folder)
    served = WebPage(model, model.load(model.snapshots[-1]), Draw(model, resolve_backend("warp")), "127.0.0.1", 18511)
    threading.Thread(target=served.prepare).start()
    yield served
    served.stop()


def get(page: WebPage, path: str) -> bytes:
    with urllib.request.urlopen(f"http://127.0.0.1:{page.port}{path}") as answer:
        return answer.read()


def test_the_server_gives_the_model_compressed_and_compares_views(page: WebPage, run_folder: Path) -> None:
    stats = json.loads((run_folder / "stats/val_step39.json").read_text())
    about = json.loads(get(page, "/about.json"))
    assert about["gaussians"] == stats["num_GS"] and about["held_out"]
    assert about["views"] == [row["view"] for row in stats["per_view"]]
    with zipfile.ZipFile(BytesIO(get(page, "/scene.sog"))) as archive:
        assert json.loads(archive.read("meta.json"))["count"] == stats["num_GS"]
    for i, row in enumerate(stats["per_view"]):
        found = json.loads(get(page, f"/compare/{i}.json"))
        assert found["psnr"] == pytest.approx(row["psnr"], abs=1e-3)
        assert all(found[name].startswith("data:image/jpeg;base64,") for name in ("photograph", "render", "error"))
    for path in ("/compare/2.json", "/compare/-1.json", "/compare/x.json", "/../pyproject.toml", "/page"):
        with pytest.raises(urllib.error.HTTPError, match="404") as refused:
            get(page, path)
        refused.value.close()  # it holds the body of the answer


def test_the_page_loads_nothing_from_elsewhere(page: WebPage) -> None:
    for path in ("/", "/page.js", "/page.css"):
        text = get(page, path).decode()
        assert "http" not in text.replace("http-equiv", "")


@pytest.mark.parametrize(("width", "height"), [(390, 700), (1000, 640)])
def test_the_page_shows_the_model_and_a_photograph_beside_its_render(
    page: WebPage, tmp_path: Path, width: int, height: int
) -> None:
    with Browser(tmp_path / "profile", width, height) as browser:
        browser.open(f"http://127.0.0.1:{page.port}/?webgl")
        wait_until(lambda: browser.evaluate("document.body.dataset.loaded"))
        picture = tmp_path / "page.png"

        def drawn() -> bool:
            browser.screenshot(picture)
            with Image.open(picture) as shown:
                middle = np.asarray(shown.convert("L"))[height // 3 : 2 * height // 3, width // 4 : 3 * width // 4]
            return bool(middle.std() > 5)

        wait_until(drawn)
        assert "Held-out photographs" in browser.text()
        if width < 600:
            turned_by_a_finger(browser, picture)
        browser.evaluate("document.getElementById('open').click()")
        loaded = "[...document.querySelectorAll('#photograph, #render')].filter(i => i.naturalWidth == 33).length"
        wait_until(lambda: browser.evaluate(loaded) == 2)
        assert "held out" in browser.text() and "PSNR" in browser.text()
        sides = browser.evaluate(
            "['photograph', 'render'].map(n => document.getElementById(n).getBoundingClientRect().right)"
        )
        below = "document.querySelector('.sse-buttonsContainer').getBoundingClientRect().top"
        panel = "document.getElementById('panel').getBoundingClientRect().bottom"
        assert browser.evaluate(panel) < browser.evaluate(below), "the panel covers the buttons of the viewer"
        assert max(sides) <= width and browser.evaluate("document.documentElement.scrollWidth") <= width
        small = "[...document.querySelectorAll('#panel button, #open')].map(b => b.getBoundingClientRect().height)"
        assert min(browser.evaluate(small)) >= 44  # pixels that a finger needs
        first = browser.evaluate("document.getElementById('title').innerText")
        browser.evaluate("document.getElementById('next').click()")
        wait_until(lambda: "2 of 2" in browser.text() and "PSNR" in browser.text())
        assert first.startswith("1 of 2: ")  # a long name is cut, the number is not
        browser.evaluate("document.getElementById('stand').click()")
        browser.evaluate("document.getElementById('close').click()")
        assert "PSNR" not in browser.text()


def turned_by_a_finger(browser: Browser, picture: Path) -> None:
    before = picture.read_bytes()
    browser.send("Emulation.setTouchEmulationEnabled", enabled=True)
    for i, kind in enumerate(("touchStart", *["touchMove"] * 4, "touchEnd")):
        points = [] if kind == "touchEnd" else [{"x": 100 + 40 * i, "y": 350}]
        browser.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    def other() -> bool:
        browser.screenshot(picture)
        return picture.read_bytes() != before

    wait_until(other)
    browser.send("Emulation.setTouchEmulationEnabled", enabled=False)


def test_a_turned_model_is_seen_from_a_turned_direction_as_before() -> None:
    generator = torch.Generator().manual_seed(0)
    rotation = Rotation.random(random_state=1).as_matrix()
    n = 30
    splats = {
        "means": torch.randn(n, 3, generator=generator),
        "quats": torch.randn(n, 4, generator=generator),
        "scales": torch.randn(n, 3, generator=generator),
        "opacities": torch.randn(n, generator=generator),
        "sh0": torch.randn(n, 1, 3, generator=generator),
        "shN": torch.randn(n, 15, 3, generator=generator),
    }
    turned = rotated(splats, rotation, 2.0)
    matrix = torch.from_numpy(rotation).float()
    torch.testing.assert_close(turned["means"], 2 * splats["means"] @ matrix.T)
    directions = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator), dim=1)
    before = spherical_harmonics(3, directions, torch.cat([splats["sh0"], splats["shN"]], dim=1))
    after = spherical_harmonics(3, directions @ matrix.T, torch.cat([turned["sh0"], turned["shN"]], dim=1))
    torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-4)

    def covariance(model: dict[str, torch.Tensor]) -> np.ndarray:
        axes = Rotation.from_quat(model["quats"][:, [1, 2, 3, 0]].numpy()).as_matrix() * np.exp(
            model["scales"].numpy()[:, None]
        )
        return axes @ axes.transpose(0, 2, 1)

    expected = 4 * rotation @ covariance(splats) @ rotation.T
    assert np.allclose(covariance(turned), expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("k", [3, 8, 15])
def test_rotated_harmonics_keep_lengths(k: int) -> None:
    matrix = rotated_harmonics(torch.from_numpy(Rotation.random(random_state=k).as_matrix()), k)
    torch.testing.assert_close(matrix @ matrix.T, torch.eye(k, dtype=torch.float64))


@pytest.mark.parametrize("ahead", [[0.2, 0.3, 0.9], [0.0, 0.0, 2.0]])
def test_up_is_up_on_the_page(ahead: list[float]) -> None:
    up = np.array([0.0, 0.0, 2.0])
    rotation = upright(up, np.array(ahead))
    assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.isclose(np.linalg.det(rotation), 1)
    assert np.allclose(rotation @ up, [0, -2, 0])
