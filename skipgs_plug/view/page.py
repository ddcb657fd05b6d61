"""The page in the browser: Gaussians, cameras, and one photograph beside its render and error."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.mask import leave_out
from skipgs_plug.trainer.metrics import psnr
from skipgs_plug.trainer.scene import Scene, View
from skipgs_plug.view.draw import to_bytes
from skipgs_plug.view.gaussians import to_gaussians
from skipgs_plug.view.upright import up_direction

# Radius of the cameras in units of the page. Viser's half precision, near plane and mouse speed suit this size.
RADIUS = 5.0
FRUSTUM = 0.04  # height of a camera's frustum as a share of RADIUS, so that a hundred cameras hide little of the model
STEP_BACK = 2.0  # distance of the first viewpoint behind the first camera, in units of the page
THUMBNAIL = 96  # longer side of the photograph in a frustum, in pixels; small, since a scene may have hundreds
ERROR_GAIN = 4.0  # factor on absolute errors: at 1, an error of 0.05 would look black
TRAIN_COLOUR, TEST_COLOUR = (90, 110, 140), (230, 120, 20)
PORTS = 50  # ports that are tried, from the given one on; hardly anyone serves as many pages at once
WORST_SHOWN = 8  # held-out views in the list of the worst ones, which then fits the page

Splats = Mapping[str, Tensor]


class Page:
    """A viser server that shows a model.

    A visitor's choice is only noted. `show` and `refresh` do the work in the thread of their caller, so that no two
    threads use the rasterizer at once.

    Args:
        scene: The scene; None for a model alone.
        draw: Renders a model as a view of the scene sees it, [H, W, 3] in [0, 1].
        steps: Iterations to choose from. The slider appears with two or more.

    Raises:
        InputError: Nothing can listen on this host and port.
    """

    def __init__(
        self,
        scene: Scene | None,
        draw: Callable[[Splats, View], Tensor],
        steps: Sequence[int] = (),
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        import viser

        require_address(host, port)
        self._draw = draw
        self._scene = scene
        self._unit = RADIUS / scene.scene_scale if scene else 1.0
        self._steps = list(steps)
        self._asked = threading.Event()
        self._handle: Any = None
        self._splats: Splats | None = None
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner, verbose or not
            self._server = viser.ViserServer(host=host, port=port, label="skipgs-plug", verbose=False)
        self._server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        self._status = self._server.gui.add_markdown("Loading ...")
        self._slider: Any = None
        if len(self._steps) > 1:
            last = len(self._steps) - 1
            self._slider = self._server.gui.add_slider("Model", min=0, max=last, step=1, initial_value=last)
            self._slider.on_update(lambda _: self._asked.set())
        if scene is not None:
            self._add_cameras(scene)

    @property
    def port(self) -> int:
        """The port it listens on: the given one, or the next free one."""
        return int(self._server.get_port())

    @property
    def chosen_step(self) -> int | None:
        """The iteration that the slider shows; None without a slider."""
        return None if self._slider is None else self._steps[int(self._slider.value)]

    @property
    def visitors(self) -> int:
        return len(self._server.get_clients())

    def wait(self) -> None:
        """Wait until a visitor has chosen something since the last call returned.

        Read the choices afterwards. A choice made between two calls is not lost.
        """
        while not self._asked.wait(0.5):  # with a timeout, since Ctrl-C does not end a wait on Windows
            pass
        self._asked.clear()

    def stop(self) -> None:
        self._server.stop()

    def show(self, splats: Splats, title: str) -> None:
        """Show another model, and draw the chosen view of it."""
        gaussians = to_gaussians(splats, self._unit)
        if self._handle is None:
            self._handle = self._server.scene.add_gaussian_splats("/model", *gaussians)
        else:
            self._handle.set_gaussians(*gaussians)
        self._splats = splats
        self._status.content = f"**{title}**, {len(splats['means']):,} Gaussians"
        self.refresh()

    def refresh(self) -> None:
        """Draw the chosen view of the model on the page."""
        if self._scene is None or self._splats is None:
            return
        view = self._views[self._choice.value]
        image = self._draw(self._splats, view).cpu()
        shown, truth = leave_out(image, view.image.float() / 255, view.mask)
        error = (shown - truth).abs() * ERROR_GAIN
        pictures = (view.image.numpy(), to_bytes(image), to_bytes(error))
        for handle, picture in zip(self._pictures, pictures, strict=True):
            handle.image = picture
        kind = "held out" if view.name in self._held_out else "trained on"
        kind += "" if view.mask is None else ", masked pixels left out"
        self._quality.content = f"PSNR **{psnr(shown, truth, view.mask):.2f} dB** ({kind})"

    def measure(self) -> None:
        """Measure every held-out view of the model on the page, colour its camera, and list the worst views."""
        if self._scene is None or self._splats is None or not self._scene.test:
            return
        quality = {}
        for view in self._scene.test:
            quality[view.name] = psnr(self._draw(self._splats, view).cpu(), view.image.float() / 255, view.mask)
        worst = sorted(quality, key=lambda name: quality[name])
        low, high = quality[worst[0]], quality[worst[-1]]
        for name, value in quality.items():
            share = (value - low) / (high - low) if high > low else 1.0
            self._frustums[name].color = (round(230 * (1 - share)), round(160 * share), 40)
        rows = "\n".join(f"| {name} | {quality[name]:.2f} |" for name in worst[:WORST_SHOWN])
        mean = sum(quality.values()) / len(quality)
        self._table.content = (
            f"{len(quality)} held-out views, mean **{mean:.2f} dB**; their cameras are green (best) to red.\n\n"
            f"| worst | PSNR dB |\n|---|---:|\n{rows}"
        )

    def _add_cameras(self, scene: Scene) -> None:
        gui = self._server.gui
        self._held_out = {view.name for view in scene.test}
        self._views = {view.name: view for view in [*scene.test, *scene.train]}
        self._choice: Any = gui.add_dropdown("View", tuple(self._views))
        self._choice.on_update(lambda _: self._asked.set())
        go = gui.add_button("Go to this camera")
        go.on_click(lambda event: self._go(event.client))
        self._shown = gui.add_checkbox("Cameras", initial_value=True)
        self._shown.on_update(lambda _: self._show_cameras())
        self._quality = gui.add_markdown("")
        blank = np.zeros((4, 4, 3), dtype=np.uint8)
        labels = ("Render", "Photograph", f"Error x{ERROR_GAIN:g}")
        render, truth, error = (gui.add_image(blank, label=label, format="jpeg") for label in labels)
        self._pictures = (truth, render, error)
        self._table = gui.add_markdown("")
        poses = {name: torch.linalg.inv(view.viewmat.double()).numpy() for name, view in self._views.items()}
        self._server.scene.set_up_direction(up_direction(np.stack(list(poses.values()))))
        self._poses = poses
        self._frustums = {name: self._add_frustum(view, poses[name]) for name, view in self._views.items()}
        first = scene.train[0]
        start, ahead = self._stand_at(first)
        camera = self._server.initial_camera
        back = (start - ahead) / np.linalg.norm(start - ahead)  # a step back, so that the cameras are seen
        camera.position, camera.look_at, camera.fov = start + STEP_BACK * back, ahead, field_of_view(first)

    def _show_cameras(self, hidden: str | None = None) -> None:
        """Show the cameras if visitors want to see them, except a camera that a visitor looks through."""
        for name, frustum in self._frustums.items():
            frustum.visible = self._shown.value and name != hidden

    def _add_frustum(self, view: View, pose: np.ndarray) -> Any:
        step = max(1, -(-max(view.width, view.height) // THUMBNAIL))
        frustum = self._server.scene.add_camera_frustum(
            f"/cameras/{view.name}",
            fov=field_of_view(view),
            aspect=view.width / view.height,
            scale=FRUSTUM * RADIUS,
            color=TEST_COLOUR if view.name in self._held_out else TRAIN_COLOUR,
            image=view.image.numpy()[::step, ::step],
            format="jpeg",
            wxyz=quaternion(pose[:3, :3]),
            position=pose[:3, 3] * self._unit,
        )

        def choose(event: Any) -> None:
            self._choice.value = view.name
            self._asked.set()
            self._go(event.client)

        frustum.on_click(choose)
        return frustum

    def _go(self, client: Any) -> None:
        view = self._views[self._choice.value]
        self._show_cameras(hidden=view.name)
        position, ahead = self._stand_at(view)
        with client.atomic():
            client.camera.position, client.camera.look_at = position, ahead
            client.camera.fov = field_of_view(view)

    def _stand_at(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """Return where a camera stands and a point it looks at, on the page."""
        pose = self._poses[view.name]
        assert self._scene is not None
        depths = (self._scene.points.double() @ view.viewmat[:3, :3].double().T + view.viewmat[:3, 3].double())[:, 2]
        ahead = depths[depths > 0]
        distance = float(ahead.median()) if len(ahead) else self._scene.scene_scale
        return pose[:3, 3] * self._unit, (pose[:3, 3] + distance * pose[:3, 2]) * self._unit


def require_address(host: str, port: int) -> None:
    """Raise InputError unless a server can listen there, or on one of the next ports.

    Viser binds the port in a thread; if that fails, its caller waits forever.
    """
    if not 1 <= port <= 65535:
        raise InputError(f"port={port} is not in 1..65535.")
    for tried in ports_from(port):
        try:
            for family, kind, protocol, _, address in socket.getaddrinfo(host, tried, type=socket.SOCK_STREAM):
                with socket.socket(family, kind, protocol) as trial:
                    trial.bind(address)
            return
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise InputError(
                    f"Cannot listen on {host}:{port} ({error.strerror or error}); give --host an address of this "
                    "machine, such as 127.0.0.1, and --port a number above 1023."
                ) from None
    raise InputError(f"Cannot listen on {host}:{port}, which is taken, as are the next ports; give another --port.")


def ports_from(port: int) -> range:
    """Return the ports that a page tries."""
    return range(port, min(port + PORTS, 65536))


def field_of_view(view: View) -> float:
    """Return the vertical angle of view in radians."""
    return float(2 * np.arctan(view.height / (2 * float(view.K[1, 1]))))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return a rotation matrix [3, 3] as (w, x, y, z)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])
