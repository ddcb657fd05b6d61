"""The few functions of torchvision that trainers of the Inria family call.

They are served only if torchvision cannot be imported. Its pretrained models are needed only for LPIPS and cannot be
replaced.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from PIL import Image
from torch import Tensor


def to_tensor(picture: Image.Image) -> Tensor:
    """Convert a picture to a tensor in [0, 1]. [C, H, W] float32"""
    pixels = torch.from_numpy(np.array(picture))
    pixels = pixels[:, :, None] if pixels.ndim == 2 else pixels
    return pixels.permute(2, 0, 1).contiguous().float() / 255.0


def to_pil_image(picture: Tensor) -> Image.Image:
    """Convert a tensor in [0, 1], [C, H, W] or [H, W], to an 8-bit picture. Truncates as torchvision does."""
    pixels = picture.detach().mul(255).to(torch.uint8)
    pixels = pixels if pixels.ndim == 2 else pixels.permute(1, 2, 0).squeeze(-1)
    return Image.fromarray(pixels.numpy())


def save_image(tensor: Tensor, fp: str | Path) -> None:
    """Write a tensor [3, H, W], [1, H, W] or [H, W] in [0, 1] to a file, in color. Rounds as torchvision does."""
    color = tensor.detach().expand(3, *tensor.shape[-2:])
    pixels = color.mul(255).add(0.5).clamp(0, 255).permute(1, 2, 0).to(torch.uint8)
    Image.fromarray(pixels.numpy()).save(fp)


class ToTensor:
    """Callable form of `to_tensor`."""

    def __call__(self, picture: Image.Image) -> Tensor:
        return to_tensor(picture)


class ToPILImage:
    """Callable form of `to_pil_image`."""

    def __call__(self, picture: Tensor) -> Image.Image:
        return to_pil_image(picture)


class Part(ModuleType):
    """A module with a few functions of torchvision's. Its class tells errors of its users from others."""


def modules() -> dict[str, ModuleType]:
    """Return the module objects by import name."""
    top = Part("torchvision", "The part of torchvision that skipgs_plug serves where it is missing.")
    utils, transforms = Part("torchvision.utils"), Part("torchvision.transforms")
    functional, models = Part("torchvision.transforms.functional"), Part("torchvision.models")
    vars(utils).update(save_image=save_image)
    vars(functional).update(to_tensor=to_tensor, to_pil_image=to_pil_image)
    vars(transforms).update(ToTensor=ToTensor, ToPILImage=ToPILImage, functional=functional)
    vars(top).update(utils=utils, transforms=transforms, models=models)
    return {module.__name__: module for module in (top, utils, transforms, functional, models)}
