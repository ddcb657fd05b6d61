"""Cameras of Inria 3DGS and its forks, shown at half their size while `Hooks.at_half_size`."""

from __future__ import annotations

import ast
from collections.abc import Container, Iterator, Sequence
from typing import Any

from torch import Tensor

from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.core.half_size import can_be_halved, halved, some_of
from skipgs_plug.core.hooks import Hooks

PHOTOGRAPH = "original_image"
# Images of a camera [..., H, W] that the loop of Inria 3DGS reads.
IMAGES = (PHOTOGRAPH, "alpha_mask", "invdepthmap", "depth_mask")
SIZES = ("image_height", "image_width")


class HalfSizeCameras:
    """Shows a camera at half its size from its training render on, until the next render or iteration.

    The loop reads the size and the images of a training camera between these two calls. All other code, such as
    evaluations, finds the camera as it is. The field of view does not depend on the size.

    Args:
        hooks: Reports to the gate.
        cameras: The training cameras; `of` says whether they can be shown.
    """

    def __init__(self, hooks: Hooks, cameras: Sequence[Any]) -> None:
        self._hooks = hooks
        self._cameras = cameras
        self._shown: Any = None  # the camera that has half its size now
        self._full: dict[str, Any] = {}  # its attributes at its own size
        hooks.on_detach("cameras at half size", self.restore)

    @classmethod
    def of(
        cls, hooks: Hooks, cameras: Sequence[Any], code: LoopCode | None, renders: Container[str]
    ) -> HalfSizeCameras | None:
        """Return an object that shows these cameras; None if they cannot be shown, or the settings do not allow it.

        Their images must be known, and large enough to be halved. The loop must read a camera after its render only.

        Args:
            hooks: Reports to the gate.
            cameras: The training cameras.
            code: The training script; None if it is not known well enough.
            renders: Names of the functions that render a training view.
        """
        if not hooks.may_halve or code is None or code.syntax is None:
            return None
        known = _reads_after_render(code.syntax, renders) and all(_is_known(camera) for camera in cameras)
        return cls(hooks, cameras) if known else None

    def photographs(self) -> Iterator[Tensor]:
        """Return some photographs [3, H, W] with values in [0, 1]."""
        return (getattr(self._cameras[i], PHOTOGRAPH) for i in some_of(len(self._cameras)))

    def rendered(self, camera: Any, training: bool) -> None:
        """Prepare a camera for a render that begins now.

        Args:
            camera: The camera.
            training: Whether it is the training render of the present iteration.
        """
        self.restore()
        if training and self._hooks.at_half_size:
            self._show(camera)

    def restore(self) -> None:
        """Give the camera that was shown last its own size."""
        for name, value in self._full.items():
            setattr(self._shown, name, value)
        self._shown, self._full = None, {}

    def _show(self, camera: Any) -> None:
        images = {name: image for name in IMAGES if (image := getattr(camera, name, None)) is not None}
        height, width = camera.image_height, camera.image_width
        # A photograph in the host's memory is halved on the device, to which the loop would copy it anyway.
        device = camera.world_view_transform.device
        smaller = {name: halved(image.to(device)) for name, image in images.items()}
        self._shown, self._full = camera, {**images, **dict(zip(SIZES, (height, width), strict=True))}
        for name, value in {**smaller, **dict(zip(SIZES, (height // 2, width // 2), strict=True))}.items():
            setattr(camera, name, value)


def _reads_after_render(loop: ast.AST, renders: Container[str]) -> bool:
    """Return whether code reads the size and the images of cameras only below a render of the camera of that name."""
    rendered: dict[str, int] = {}  # line of the first render, by the name of the camera
    reads = []
    for node in ast.walk(loop):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in renders and node.args:
            camera = node.args[0]
            if isinstance(camera, ast.Name):
                rendered[camera.id] = min(node.lineno, rendered.get(camera.id, node.lineno))
        if isinstance(node, ast.Attribute) and node.attr in (*IMAGES, *SIZES):
            reads.append(node)
    return all(
        isinstance(read.value, ast.Name) and rendered.get(read.value.id, read.lineno) < read.lineno for read in reads
    )


def _is_known(camera: Any) -> bool:
    """Return whether a camera holds its photograph, and no image but those of `IMAGES`."""
    held = vars(camera)
    size = tuple(held.get(name, 0) for name in SIZES)
    if PHOTOGRAPH not in held or not can_be_halved(*size):
        return False
    others = {**held, **held.get("_parameters", {}), **held.get("_buffers", {})}.items()
    return all(name in IMAGES or tuple(getattr(value, "shape", ()))[-2:] != size for name, value in others)
