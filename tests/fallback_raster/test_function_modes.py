"""Calls of torch that no function mode of the caller sees."""

from __future__ import annotations

from typing import Any

import torch
from raster_scenes import leaves, random_scene
from torch.overrides import TorchFunctionMode

from skipgs_plug.compat.ssim import fused_ssim
from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.runtime.function_modes import without_function_modes


class Seen(TorchFunctionMode):
    """Keeps the functions of torch that are called."""

    def __init__(self) -> None:
        super().__init__()
        self.functions: list[Any] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.functions.append(func)
        return func(*args, **(kwargs or {}))


def test_a_mode_sees_no_call_of_a_function_without_modes() -> None:
    inputs = leaves(random_scene(n=40, width=32, height=24), torch.float32)
    images = torch.rand(2, 1, 3, 24, 32)
    with Seen() as seen:
        image, _, _ = without_function_modes(rasterization)(**inputs)
        fused_ssim(images[0].requires_grad_(), images[1])
        before = len(seen.functions)
        image.sum()
    assert before <= 4  # those of the test itself
    assert seen.functions[-1] is torch.Tensor.sum
