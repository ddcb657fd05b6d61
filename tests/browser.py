"""A headless Chromium that tests talk to by its debugging protocol."""

from __future__ import annotations

import base64
import itertools
import json
import os
import shutil
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
# Seconds until a browser that does not answer counts as hung: where WebGL runs on a CPU that others use too, one
# picture takes a while. Tests that open one need `pytest.mark.timeout(600)`.
PATIENCE = 180.0
SOFTWARE_WEBGL = ("--enable-unsafe-swiftshader", "--use-angle=swiftshader")


def find_chromium() -> str:
    """Return the browser's path; without one, skip, or fail in CI."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        if os.environ.get("CI") == "true":
            pytest.fail("no chromium found; CI must open pages in a real browser")
        pytest.skip("no chromium found; install it to open pages in a real browser")
    return browser


class Browser:
    """One tab, `width` x `height` pixels."""

    def __init__(self, profile: Path, width: int = 1300, height: int = 900) -> None:
        size = f"--window-size={width},{height}"
        data = f"--user-data-dir={profile}"
        command = [find_chromium(), *FLAGS, *SOFTWARE_WEBGL, size, data, "--remote-debugging-port=0", "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._numbers = itertools.count(1)
        try:
            port_file = profile / "DevToolsActivePort"
            wait_until(lambda: port_file.exists() and "\n" in port_file.read_text())
            port = port_file.read_text().split()[0]
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                (tab, *_) = [entry for entry in json.load(answer) if entry["type"] == "page"]
            self._socket = connect(tab["webSocketDebuggerUrl"], max_size=None)
            # The window's frame takes part of its size; this sets the page's own.
            metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
            self.send("Emulation.setDeviceMetricsOverride", **metrics)
        except BaseException:
            self._end()
            raise

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]  # type: ignore[no-any-return]

    def open(self, url: str) -> None:
        self.send("Page.navigate", url=url)
        wait_until(lambda: self.evaluate("document.readyState") == "complete" and self.evaluate("location.href") == url)

    def evaluate(self, script: str) -> Any:
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def text(self) -> str:
        return self.evaluate("document.body.innerText") or ""

    def screenshot(self, path: Path, whole: bool = False) -> None:
        picture = self.send("Page.captureScreenshot", format="png", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(picture["data"]))

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()
        self._end()

    def _end(self) -> None:
        self._process.terminate()
        self._process.wait(timeout=PATIENCE)


def wait_until(condition: Any, seconds: float = PATIENCE) -> None:
    """Return when the condition holds; fail when it does not within `seconds`."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            pytest.fail("the browser did not get there in time")
        time.sleep(0.1)
