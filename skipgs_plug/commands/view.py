"""`skipgs-plug view MODEL`: a trained model in the browser."""

from __future__ import annotations

import contextlib
import socket
import threading

from torch import Tensor

from skipgs_plug.commands.options.view import Args
from skipgs_plug.trainer.backend import Backend, resolve_backend
from skipgs_plug.trainer.exposure import fit_colours
from skipgs_plug.trainer.scene import View
from skipgs_plug.view.draw import Painter
from skipgs_plug.view.model import Model, open_model
from skipgs_plug.view.page import Page, Splats
from skipgs_plug.view.web.server import WebPage

# Hosts that stand for all addresses of this machine, and an address of each kind that is in no network: it is reserved
# for documentation.
ELSEWHERE = {"0.0.0.0": (socket.AF_INET, "192.0.2.1"), "::": (socket.AF_INET6, "2001:db8::1")}


class Draw:
    """Renders a model with the exposure of its photographs."""

    def __init__(self, model: Model, backend: Backend) -> None:
        self._model, self._painter = model, Painter.of(model, backend)

    def __call__(self, splats: Splats, view: View) -> Tensor:
        image = self._painter.draw(splats, view.viewmat, view.K, view.width, view.height)[0]
        if not self._model.exposure:
            return image
        # The model has no exposure, but the photograph beside it has.
        return fit_colours(image, view.image / 255.0, view.mask).clamp(0, 1)


def run(args: Args) -> int:
    """Serve the page; see `Args`."""
    backend = resolve_backend(args.backend)  # refused before the scene is read, which can take minutes
    model = open_model(args.model, args.scene, args.data_factor)
    draw = Draw(model, backend)
    with contextlib.suppress(KeyboardInterrupt):
        (serve_cameras if args.cameras else serve_model)(model, draw, args)
    return 0


def serve_model(model: Model, draw: Draw, args: Args) -> None:
    """Serve the last model, compressed, with held-out photographs beside their renders."""
    splats = model.load(model.snapshots[-1])
    page = WebPage(model, splats, draw, args.host, args.port)
    try:
        print_address(model, args.host, page.port)
        page.prepare()
        while True:  # with a timeout, since Ctrl-C does not end a wait on Windows
            threading.Event().wait(0.5)
    finally:
        page.stop()


def serve_cameras(model: Model, draw: Draw, args: Args) -> None:
    """Serve every model with its cameras and errors."""
    by_step = {snapshot.step: snapshot for snapshot in model.snapshots}
    steps = [step for step in by_step if step is not None]
    page = Page(model.scene, draw, steps, args.host, args.port)
    print_address(model, args.host, page.port)
    shown = object()
    try:
        while True:
            step = page.chosen_step if page.chosen_step is not None else model.snapshots[-1].step
            if step != shown:
                page.show(model.load(by_step[step]), model.name if step is None else f"Iteration {step:,}")
                page.measure()
                shown = step
            else:
                page.refresh()
            page.wait()
    finally:
        page.stop()


def print_address(model: Model, host: str, port: int) -> None:
    """Print where the page is, for a phone too if the server listens on all addresses."""
    host = address_in_network(host) if host in ELSEWHERE else host
    host = f"[{host}]" if ":" in host else host  # IPv6
    print(f"{model.name}: http://{host}:{port} (Ctrl-C ends)", flush=True)


def address_in_network(host: str) -> str:
    """Return the address at which others reach this machine, its name without a network; `host` is in `ELSEWHERE`."""
    family, elsewhere = ELSEWHERE[host]
    try:
        # Connecting a UDP socket sends nothing. It chooses the address from which packets would leave.
        with socket.socket(family, socket.SOCK_DGRAM) as trial:
            trial.connect((elsewhere, 9))
            return str(trial.getsockname()[0])
    except OSError:
        return socket.gethostname()
