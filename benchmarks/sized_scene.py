"""Writes a scene for scripts that take held-out views and camera sizes otherwise than all others."""

import os
from pathlib import Path

from PIL import Image


def sized_scene(scene: Path, factor: int, out: Path, with_held_out: bool = True) -> None:
    """Write a COLMAP scene that nerfstudio reads, at a downscale factor of 1, as other scripts read `scene`.

    nerfstudio divides the sizes of cameras by the factor, which may differ from the sizes of reduced photographs. And
    it holds out every eighth view by number, not by name. Here, cameras have the sizes of the photographs, and lists
    name the views of each split.

    Args:
        scene: COLMAP folder.
        factor: Factor by which its photographs are reduced.
        out: Folder to write, with a link to the photographs.
        with_held_out: Whether the model keeps the held-out views; False for scripts that hold out none.
    """
    import pycolmap

    model = pycolmap.Reconstruction(str(scene / "sparse/0"))
    photographs = (scene / ("images" if factor == 1 else f"images_{factor}")).resolve()
    for camera in model.cameras.values():
        name = next(image.name for image in model.images.values() if image.camera_id == camera.camera_id)
        with Image.open(photographs / name) as photograph:
            size = photograph.size
        if camera.model == pycolmap.CameraModelId.SIMPLE_PINHOLE:  # one focal length does not fit a rounded size
            focal, *centre = camera.params
            camera.model, camera.params = pycolmap.CameraModelId.PINHOLE, [focal, focal, *centre]
        camera.rescale(*size)
    names = sorted(image.name for image in model.images.values())
    held_out = names[::8]
    if not with_held_out:
        for image in [image for image in model.images.values() if image.name in held_out]:
            model.deregister_frame(image.frame_id)
    (out / "sparse/0").mkdir(parents=True)
    model.write(str(out / "sparse/0"))
    os.symlink(photographs, out / "images")
    for split in ("train", "val", "test"):
        listed = sorted(set(names) - set(held_out)) if split == "train" else held_out
        (out / f"{split}_list.txt").write_text("".join(f"{name}\n" for name in listed), encoding="utf-8")
