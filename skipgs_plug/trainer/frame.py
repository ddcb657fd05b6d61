"""Coordinates of training: around the origin, with cameras that spread over a length of 1.

A scene trains in the same way wherever it lies and whatever its unit is: position and unit are removed in float64 when
the scene is loaded. Training in coordinates of the dataset would have two problems. Near 500,000, float32 has steps of
0.03, which would blur a scene in map coordinates. And densification turns rounding differences of one bit into another
number of Gaussians, so a scene in feet would train differently than the same scene in metres.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

# Distance from the origin, in extents, above which a model counts as far away: float32 would lose fine structure.
FAR = 100.0
SMALL, LARGE = 2.0**-6, 2.0**10  # extents between which a model without cameras keeps its unit
MOST = 0.9  # share of the Gaussians within the extent of a model without cameras: the rest may be outliers
SAME = 1e-5  # relative difference of two frames that counts as rounding, as a share of the scene's size
# Cameras turn on the spot if their extent is a smaller share of the distance to the points. Then that distance is the
# extent.
ON_THE_SPOT = 0.01


@dataclass(frozen=True)
class Frame:
    """Local coordinates: (position in the dataset - `centre`) / `unit`.

    Attributes:
        centre: Subtracted from positions, in units of the dataset.
        unit: Divisor of lengths: the largest distance of a training camera from the centre of all training cameras, in
            units of the dataset.
    """

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    unit: float = 1.0

    @classmethod
    def of(cls, viewmats: np.ndarray, points: np.ndarray) -> Frame:
        """Return the frame of cameras [C, 4, 4] (world to camera) and points [M, 3], float64.

        Cameras have an extent of 1 in it. If all of them are in one place, the median distance to the points is 1.
        """
        centres = -np.linalg.solve(viewmats[:, :3, :3], viewmats[:, :3, 3:])[..., 0]
        centre = centres.mean(axis=0)
        extent = float(np.linalg.norm(centres - centre, axis=1).max())
        depth = float(np.median(np.linalg.norm(points - centre, axis=1))) if len(points) else 0.0
        extent = depth if extent < ON_THE_SPOT * depth else extent
        if not (extent > 0.0 and math.isfinite(extent)):
            return cls()
        return cls((float(centre[0]), float(centre[1]), float(centre[2])), extent)

    @classmethod
    def around(cls, positions: np.ndarray) -> Frame:
        """Return the frame of a model alone, by its positions [N, 3], of which some may be far off.

        It keeps the coordinates of the file if float32 is precise enough for them.
        """
        positions = np.asarray(positions, dtype=np.float64)
        centre = np.median(positions, axis=0)
        extent = float(np.quantile(np.linalg.norm(positions - centre, axis=1), MOST))
        if not (extent > 0.0 and math.isfinite(extent)):
            return cls()
        kept = SMALL <= extent < LARGE
        if kept and float(np.abs(centre).max()) < FAR * extent:
            return cls()
        unit = 1.0 if kept else 2.0 ** math.floor(math.log2(extent))
        return cls((float(centre[0]), float(centre[1]), float(centre[2])), unit)

    @property
    def moves(self) -> bool:
        """Whether local coordinates differ from those of the dataset."""
        return self != Frame()

    def is_like(self, other: Frame, size: float) -> bool:
        """Whether both frames are equal up to rounding, for a scene of this size in local units."""
        apart = max(abs(own - their) for own, their in zip(self.centre, other.centre, strict=True))
        return abs(self.unit / other.unit - 1.0) <= SAME and apart <= SAME * size * self.unit

    def as_dict(self) -> dict[str, object]:
        """Return the entries of skipgs.json and cfg.yml: the centre and the unit."""
        return {"centre": list(self.centre), "unit": self.unit}

    def dataset_length(self, length: float) -> float:
        """Return a local length in units of the dataset."""
        return length * self.unit

    def to_local(self, positions: np.ndarray) -> np.ndarray:
        """Return positions [M, 3] of the dataset in local coordinates, float64."""
        return (np.asarray(positions, dtype=np.float64) - self.centre) / self.unit

    def local_pose(self, viewmat: Tensor) -> Tensor:
        """Return a pose [4, 4], dataset to camera, as local coordinates to camera, float64; depths are local too."""
        local = viewmat.double().clone()
        local[:3, 3] = (local[:3, :3] @ torch.tensor(self.centre, dtype=torch.float64) + local[:3, 3]) / self.unit
        return local

    def dataset_pose(self, viewmat: Tensor) -> Tensor:
        """Return the inverse of `local_pose`."""
        pose = viewmat.double().clone()
        pose[:3, 3] = pose[:3, 3] * self.unit - pose[:3, :3] @ torch.tensor(self.centre, dtype=torch.float64)
        return pose

    def local_splats(self, splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return raw parameters in coordinates of the dataset as local ones, float32."""
        result = dict(splats)
        if self.moves:
            result["means"] = torch.from_numpy(self.to_local(splats["means"].detach().cpu().numpy()))
            result["scales"] = splats["scales"] - math.log(self.unit)
        result["means"] = result["means"].float()
        return result

    def dataset_splats(self, splats: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return local raw parameters in coordinates of the dataset; positions in float64 where float32 loses some."""
        result = dict(splats)
        if not self.moves:
            return result
        means = splats["means"].detach().cpu().double() * self.unit
        means = means + torch.tensor(self.centre, dtype=torch.float64)
        far = max(map(abs, self.centre)) >= FAR * self.unit
        result["means"] = means if far else means.float()
        result["scales"] = splats["scales"].detach().cpu() + math.log(self.unit)
        return result


def is_far(positions: np.ndarray) -> bool:
    """Return whether positions [N, 3] are so far from the origin, for their extent, that float32 loses some of them."""
    return bool(len(positions)) and float(np.abs(positions).max()) > FAR * float(np.ptp(positions, axis=0).max())


def frame_of(content: Mapping[str, object]) -> Frame:
    """Return the frame that `as_dict` described; the coordinates of the dataset if there is no entry.

    Raises:
        ValueError, TypeError: The entries are not a frame.
    """
    if "centre" not in content:
        return Frame()
    x, y, z = (float(value) for value in content["centre"])  # type: ignore[attr-defined]
    frame = Frame((x, y, z), float(content["unit"]))  # type: ignore[arg-type]
    if not all(math.isfinite(value) for value in (*dataclasses.astuple(frame)[0], frame.unit)) or frame.unit <= 0:
        raise ValueError(f"no frame: {content}")
    return frame
