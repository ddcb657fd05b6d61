"""The page in a real browser: a finished run, a PLY alone, and a run under way."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import PATIENCE, Browser, wait_until
from PIL import Image

from skipgs_plug.trainer import TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.ply import read_ply, write_ply
from skipgs_plug.view.gaussians import to_gaussians
from skipgs_plug.view.live import LiveView

pytestmark = pytest.mark.timeout(600)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path / "profile", width=800, height=500) as opened:  # small: WebGL runs on the CPU
        yield opened


@contextlib.contextmanager
def serve(*arguments: str, end: signal.Signals = signal.SIGINT) -> Iterator[str]:
    """Run the command; yields the address it prints, ends it by a signal, at which it has nothing to complain of."""
    command = [sys.executable, "-m", "skipgs_plug", "view", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stderr is not None
    try:
        line = process.stdout.readline()
        yield re.search(r"http://\S+", line).group(0) + "/"
        process.send_signal(end)
        complaints = process.communicate(timeout=PATIENCE)[1]
        assert process.returncode == 0 and complaints == ""
    finally:
        process.kill()
        process.communicate()


def press(browser: Browser, selector: str, key: str) -> None:
    browser.evaluate(f"document.querySelector('{selector}').focus()")
    for kind in ("keyDown", "keyUp"):
        browser.send("Input.dispatchKeyEvent", type=kind, key=key, code=key)


def test_a_run_is_shown_with_its_errors_and_checkpoints(run_folder, browser, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(run_folder, folder)
    earlier = {name: tensor[:100] for name, tensor in read_ply(folder / "ply/point_cloud_39.ply").items()}
    write_ply(earlier, folder / "ply/point_cloud_19.ply")
    stats = json.loads((folder / "stats/val_step39.json").read_text())
    with serve(str(folder), "--cameras", "--port", "18411", end=signal.SIGTERM) as url:
        browser.open(url)
        # The page is filled in several messages, in any order.
        gaussians = f"{stats['num_GS']:,} Gaussians"
        for expected in ("Iteration 39", gaussians, "held out", "mask", f"mean {stats['psnr']:.2f} dB"):
            wait_until(lambda expected=expected: expected in browser.text())
        pictures = "[...document.images].filter(i => i.naturalWidth == 33).length"
        wait_until(lambda: browser.evaluate(pictures) == 3)  # the page shows render, photograph and error
        picture = tmp_path / "page.png"

        def drawn() -> bool:
            browser.screenshot(picture)
            with Image.open(picture) as shown:
                return np.asarray(shown.convert("L"))[150:450, 50:400].std() > 5

        wait_until(drawn)
        press(browser, "[role=slider]", "ArrowLeft")
        wait_until(lambda: "Iteration 19" in browser.text() and "100 Gaussians" in browser.text())
        wait_until(lambda: f"mean {stats['psnr']:.2f} dB" not in browser.text())


def test_a_ply_is_shown_without_a_scene(ply, browser):
    with serve(str(ply), "--cameras", "--port", "18431") as url:
        browser.open(url)
        wait_until(lambda: "point_cloud_39" in browser.text() and "Gaussians" in browser.text())
        assert "PSNR" not in browser.text()


def test_training_is_shown_and_not_changed(scene_file, browser):
    scene = load_scene(scene_file)
    alone = Trainer(TrainConfig(max_steps=60), scene)
    alone.train(progress=False)
    watched = Trainer(TrainConfig(max_steps=60), scene)
    state = torch.random.get_rng_state()
    with LiveView(watched, port=18451) as live:
        shown = []
        show = live.page.show
        live.page.show = lambda splats, title: (shown.append(title), show(splats, title))
        watched.on_step = live.iteration
        watched.train(until=5, progress=False)
        assert shown == []  # there is no visitor
        browser.open(f"http://127.0.0.1:{live.page.port}/")
        wait_until(lambda: live.page.visitors == 1)
        time.sleep(0.6)  # LiveView looks for visitors twice a second
        watched.train(until=40, progress=False)
        wait_until(lambda: "of 60" in browser.text() and "PSNR" in browser.text())
        watched.train(progress=False)
    assert 1 <= len(shown) < 55
    assert torch.equal(torch.random.get_rng_state(), state)
    assert all(torch.equal(alone.splats[name], watched.splats[name]) for name in alone.splats)
    assert not [thread for thread in threading.enumerate() if thread.name == "viser"]


def test_gaussians_have_the_covariances_of_their_parameters():
    generator = torch.Generator().manual_seed(0)
    splats = {
        "means": torch.randn(5, 3, generator=generator),
        "quats": torch.randn(5, 4, generator=generator),
        "scales": torch.randn(5, 3, generator=generator),
        "opacities": torch.tensor([0.0, 100.0, -100.0, 1.0, 2.0]),
        "sh0": torch.zeros(5, 1, 3),
    }
    shown = to_gaussians(splats, unit=2.0)
    assert np.allclose(shown.centers, 2 * splats["means"].numpy())
    lengths = np.sort(np.sqrt(np.linalg.eigvalsh(shown.covariances.astype(np.float64))), axis=1)
    assert np.allclose(lengths, np.sort(2 * splats["scales"].exp().numpy(), axis=1), rtol=1e-3)
    assert np.allclose(shown.opacities[:3, 0], [0.5, 1, 0]) and np.allclose(shown.rgbs, 0.5)
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(splats["quats"][:, [1, 2, 3, 0]].numpy()).as_matrix()
    expected = turn @ (np.eye(3) * (2 * splats["scales"].exp().numpy()[:, None]) ** 2) @ turn.transpose(0, 2, 1)
    assert np.allclose(shown.covariances, expected, rtol=1e-3, atol=1e-4)


def test_gaussians_larger_than_half_precision_holds_stay_finite():
    splats = {
        "means": torch.zeros(1, 3),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 1.0]]),  # a quarter turn: covariances beside the diagonal too
        "scales": torch.tensor([[8.0, 1.0, 1.0]]),
        "opacities": torch.zeros(1),
        "sh0": torch.zeros(1, 1, 3),
    }
    halves = to_gaussians(splats, unit=1.0).covariances.astype(np.float16)
    assert np.isfinite(halves).all() and halves.max() == np.finfo(np.float16).max
