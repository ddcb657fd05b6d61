"""`skipgs-plug view MODEL`: a trained model in the browser."""

from __future__ import annotations

from torch import Tensor

from skipgs_plug.commands.options.view import Args
from skipgs_plug.trainer.exposure import fit_colours
from skipgs_plug.trainer.scene import View
from skipgs_plug.view.draw import Painter
from skipgs_plug.view.model import open_model
from skipgs_plug.view.page import Page, Splats


def run(args: Args) -> int:
    """Serve the page; see `Args`."""
    model = open_model(args.model, args.scene, args.data_factor)
    painter = Painter.of(model, args.backend)

    def draw(splats: Splats, view: View) -> Tensor:
        image = painter.draw(splats, view.viewmat, view.K, view.width, view.height)[0]
        # Models know nothing of the exposure of photographs, which they are compared with here.
        return fit_colours(image, view.image / 255.0, view.mask).clamp(0, 1) if model.exposure else image

    by_step = {snapshot.step: snapshot for snapshot in model.snapshots}
    steps = [step for step in by_step if step is not None]
    page = Page(model.scene, draw, steps, args.host, args.port)
    print(f"{model.name}: http://{args.host}:{page.port} (Ctrl-C ends)", flush=True)
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
    except KeyboardInterrupt:
        return 0
    finally:
        page.stop()
