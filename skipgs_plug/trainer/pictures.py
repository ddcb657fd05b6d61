"""Pictures of a comparison: truth, renders and their errors; loss and skips over iterations; pictures inside a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from torch import Tensor

from skipgs_plug.trainer.files import write_aside
from skipgs_plug.trainer.scene import View

ERROR_GAIN = 4.0  # factor on absolute errors: at 1, an error of 0.05 would look black
ROWS = 3  # views to show, at most: more rows do not fit on one screen
ZOOM = 2  # side of one pixel of the render in the picture, in pixels, so that small renders stay legible
# Width of a column, as a multiple of its title's height. The title stays legible where a page shrinks the picture, and
# "share=auto error x4" is the longest one.
COLUMN_WIDTH = 10
LEAST_HEIGHT = 11  # least height of a title, in pixels: smaller titles cannot be read
SMOOTH = 0.95  # decay of the running mean of losses per iteration: about the mean of the last 20


@dataclass
class Curve:
    """Loss and skip flag of every refinement iteration of one run."""

    name: str
    steps: list[int] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    skipped: list[bool] = field(default_factory=list)

    def add(self, step: int, loss: float, skipped: bool) -> None:
        self.steps.append(step)
        self.losses.append(loss)
        self.skipped.append(skipped)


def save_comparison(path: Path, views: list[View], renders: Mapping[str, Sequence[Tensor]]) -> None:
    """Write a PNG with columns truth, each run, error of each run, for up to `ROWS` views.

    Args:
        path: PNG file to write.
        views: Held-out views with their photographs.
        renders: Renders of these views by name of the run, each [H, W, 3] in [0, 1].
    """
    from PIL import Image, ImageDraw, ImageFont

    picked = np.linspace(0, len(views) - 1, min(ROWS, len(views))).round().astype(int)
    lines = []
    for i in picked:
        truth = views[i].image.numpy().astype(np.float32) / 255.0
        images = [render[i].numpy().clip(0, 1) for render in renders.values()]
        errors = [(ERROR_GAIN * np.abs(image - truth)).clip(0, 1) for image in images]
        lines.append(np.concatenate([truth, *images, *errors], axis=1))
    pixels = np.rint(np.concatenate(lines) * 255).astype(np.uint8).repeat(ZOOM, axis=0).repeat(ZOOM, axis=1)
    titles = ("truth", *renders, *(f"{name} error x{ERROR_GAIN:g}" for name in renders))
    column = pixels.shape[1] // len(titles)
    size = max(LEAST_HEIGHT, column // COLUMN_WIDTH)
    header = size + size // 2
    sheet = Image.new("RGB", (pixels.shape[1], pixels.shape[0] + header), "white")
    sheet.paste(Image.fromarray(pixels), (0, header))
    for k, title in enumerate(titles):
        ImageDraw.Draw(sheet).text((k * column + 6, size // 8), title, fill="black", font=ImageFont.load_default(size))
    with write_aside(path) as temporary:
        sheet.save(temporary, format="PNG")


def plot_refinement(path: Path, curves: list[Curve]) -> None:
    """Plot smoothed loss of each run, and a tick for every skipped iteration with the share skipped so far."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.8), layout="constrained")
    losses, skips = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    for curve in curves:
        (line,) = losses.plot(curve.steps, smooth(curve.losses), label=curve.name, linewidth=1.2)
        if any(curve.skipped):
            steps, skipped = np.array(curve.steps), np.array(curve.skipped)
            skips.vlines(steps[skipped], 0, 1, color="0.75", linewidth=0.5)
            skipped_so_far = np.cumsum(skipped) / np.arange(1, len(skipped) + 1)
            skips.plot(steps, skipped_so_far, color=line.get_color(), label=f"{curve.name}: share skipped so far")
            skips.legend(loc="upper left", fontsize="small")
    losses.set_ylabel("training loss (running mean)")
    losses.legend()
    skips.set_ylim(0, 1)
    skips.set_ylabel("skipped")
    skips.set_xlabel("iteration")
    with write_aside(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)


def smooth(values: list[float]) -> list[float]:
    """Return the bias-corrected exponential running mean."""
    total, weight, out = 0.0, 0.0, []
    for value in values:
        total = SMOOTH * total + (1 - SMOOTH) * value
        weight = SMOOTH * weight + (1 - SMOOTH)
        out.append(total / weight)
    return out


def jpeg_uri(picture: np.ndarray) -> str:
    """Return a picture [H, W, 3] uint8 as the data URI of a JPEG, which needs a tenth of the bytes of a PNG."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, format="JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode()
