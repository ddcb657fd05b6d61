"""The server of the page: the compressed model, and held-out photographs beside their renders."""

from __future__ import annotations

import functools
import json
import logging
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.mask import leave_out
from skipgs_plug.trainer.metrics import psnr
from skipgs_plug.trainer.pictures import jpeg_uri
from skipgs_plug.trainer.scene import View
from skipgs_plug.view.draw import to_bytes
from skipgs_plug.view.model import Model
from skipgs_plug.view.page import ERROR_GAIN, RADIUS, Splats, field_of_view, ports_from, require_address
from skipgs_plug.view.sog import to_sog
from skipgs_plug.view.upright import up_direction
from skipgs_plug.view.web.rotate_model import rotated, upright

log = logging.getLogger(__name__)

PAIRS = 5e7  # see `to_sog`; a tenth of its default, so that the page opens sooner
KEPT = 32  # comparisons that stay in memory, at most; a visitor who goes back and forth looks at fewer
TO_PAGE = np.diag([-1.0, -1.0, 1.0])  # the viewer turns a model half a turn about z
POSE = ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 60.0)  # position, target, degrees of the first view without a scene
FILES = {
    "/": ("page/index.html", "text/html; charset=utf-8"),
    "/page.css": ("page/page.css", "text/css"),
    "/page.js": ("page/page.js", "text/javascript"),
    "/viewer.css": ("supersplat/viewer.css", "text/css"),
    "/viewer.js": ("supersplat/viewer.js.gz", "text/javascript"),
}


class WebPage:
    """Serves a page with one model.

    `prepare` compresses the model. Visitors who ask for it earlier wait. Renders are made one at a time.

    Args:
        model: The model with its scene.
        splats: Its raw parameters.
        draw: Renders the model as a view of its scene sees it, [H, W, 3] in [0, 1].

    Raises:
        InputError: Nothing can listen on this host and port.
    """

    def __init__(
        self, model: Model, splats: Splats, draw: Callable[[Splats, View], Tensor], host: str, port: int
    ) -> None:
        self._model, self._splats, self._draw = model, splats, draw
        scene = model.scene
        self._views: list[View] = [] if scene is None else scene.test or scene.train
        self._unit = 1.0 if scene is None else RADIUS / scene.scene_scale
        self._rotation = np.eye(3)
        if scene is not None:
            poses = np.stack([torch.linalg.inv(view.viewmat.double()).numpy() for view in scene.train])
            self._rotation = upright(up_direction(poses), poses[0, :3, 2])
        self._compressed: Future[bytes] = Future()
        self._drawing = threading.Lock()
        self.compare = functools.lru_cache(KEPT)(self._compare)
        require_address(host, port)
        self._server = listen(host, port, self)
        self._thread = threading.Thread(target=self._server.serve_forever, name="skipgs_plug page", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port it listens on: the given one, or the next free one."""
        return int(self._server.server_address[1])

    def prepare(self) -> None:
        """Compress the model."""
        turned = rotated(self._splats, self._rotation, self._unit)
        self._compressed.set_result(to_sog(turned, self._model.antialiased, PAIRS))

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def answer(self, path: str) -> tuple[bytes, str] | None:
        """Return content and type of an address; None if there is no such page."""
        if path in FILES:
            name, kind = FILES[path]
            return files("skipgs_plug.view.web").joinpath(name).read_bytes(), kind
        if path == "/scene.sog":
            return self._compressed.result(), "application/octet-stream"
        if path == "/about.json":
            return self._about, "application/json"
        number = path.removeprefix("/compare/").removesuffix(".json")
        if path.startswith("/compare/") and number.isascii() and number.isdigit() and int(number) < len(self._views):
            with self._drawing:
                return json.dumps(self.compare(int(number))).encode(), "application/json"
        return None

    @functools.cached_property
    def _about(self) -> bytes:
        scene = self._model.scene
        first = POSE if scene is None else self._pose(scene.train[0])
        cameras = [self._pose(view) for view in self._views]
        about = {
            "name": self._model.name,
            "gaussians": len(self._splats["means"]),
            "held_out": bool(scene and scene.test),
            "views": [view.name for view in self._views],
            "settings": {
                "version": 2,
                "tonemapping": "none",
                "highPrecisionRendering": False,
                "background": {"color": list(self._model.background)},
                "postEffectSettings": EFFECTS,
                "animTracks": [],
                "cameras": [{"initial": camera(first)}],
                "annotations": [
                    {"position": pose[1], "title": view.name, "text": "", "camera": {"initial": camera(pose)}}
                    for view, pose in zip(self._views, cameras, strict=True)
                ],
                "startMode": "default",
            },
        }
        return json.dumps(about).encode()

    def _pose(self, view: View) -> tuple[list[float], list[float], float]:
        """Return where a camera stands and a point it looks at, on the page, and its vertical angle in degrees."""
        assert self._model.scene is not None
        viewmat = view.viewmat.double()
        pose = torch.linalg.inv(viewmat).numpy()
        depths = (self._model.scene.points.double() @ viewmat[2, :3] + viewmat[2, 3]).numpy()
        distance = float(np.median(depths[depths > 0])) if (depths > 0).any() else self._model.scene.scene_scale
        to_page = TO_PAGE @ self._rotation * self._unit
        here, ahead = to_page @ pose[:3, 3], to_page @ (pose[:3, 3] + distance * pose[:3, 2])
        return here.tolist(), ahead.tolist(), float(np.degrees(field_of_view(view)))

    def _compare(self, number: int) -> dict[str, Any]:
        view = self._views[number]
        image = self._draw(self._splats, view).cpu()
        shown, truth = leave_out(image, view.image.float() / 255, view.mask)
        error = to_bytes((shown - truth).abs() * ERROR_GAIN)
        pictures = {"photograph": view.image.numpy(), "render": to_bytes(image), "error": error}
        return {
            "psnr": psnr(shown, truth, view.mask),
            "gain": ERROR_GAIN,
            **{name: jpeg_uri(picture) for name, picture in pictures.items()},
        }


def camera(pose: tuple[list[float], list[float], float]) -> dict[str, Any]:
    position, target, fov = pose
    return {"position": position, "target": target, "fov": fov}


# The viewer's format requires all of these effects. They are off.
EFFECTS = {
    "sharpness": {"enabled": False, "amount": 0},
    "bloom": {"enabled": False, "intensity": 1, "blurLevel": 2},
    "grading": {"enabled": False, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
    "vignette": {"enabled": False, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
    "fringing": {"enabled": False, "intensity": 0.5},
}


def listen(host: str, port: int, page: WebPage) -> ThreadingHTTPServer:
    """Return a server on the next free port."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            try:
                found = page.answer(self.path.split("?")[0])
                status = 200 if found else 404
            except Exception:  # the visitor gets status 500, and the server goes on
                log.exception("%s cannot be answered.", self.path)
                found, status = None, 500
            content, kind = found or (b"There is no such page.\n", "text/plain")
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-cache")
            if content[:2] == b"\x1f\x8b":
                self.send_header("Content-Encoding", "gzip")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *arguments: Any) -> None:
            log.debug(format, *arguments)

    class Server(ThreadingHTTPServer):
        address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        daemon_threads = True
        allow_reuse_address = False

        def handle_error(self, request: Any, client_address: Any) -> None:
            log.debug("A visitor left before the answer.", exc_info=True)

    for tried in ports_from(port):
        try:
            return Server((host, tried), Handler)
        except OSError:
            if tried == ports_from(port)[-1]:
                raise
    raise AssertionError("no port was tried")
