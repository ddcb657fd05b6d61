"""Stand-in for the `SceneManager` of another package named pycolmap, which gsplat's script needs up to 1.5.3.

The two packages have the same import name. This one reads models with the official package, so nothing is replaced.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

# Names of COLMAP's camera models, in the order of their numbers.
MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)


class Image(NamedTuple):
    """A registered image. Its pose maps world points to camera space."""

    name: str
    camera_id: int
    rotation: np.ndarray  # [3, 3]
    tvec: np.ndarray  # [3]

    def R(self) -> np.ndarray:
        """Rotation of the pose. [3, 3]"""
        return self.rotation


class Camera:
    """A camera: `fx fy cx cy` in pixels, distortion `k1 k2 p1 ...`, and `camera_type`, the number of its model."""

    def __init__(self, camera: Any) -> None:
        # A number and not a name, because gsplat compares it with numbers only when it warns of distortion.
        self.camera_type = MODELS.index(getattr(camera.model, "name", str(camera.model)))
        self.width, self.height = camera.width, camera.height
        K = camera.calibration_matrix()
        self.fx, self.fy, self.cx, self.cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        for name, value in zip(camera.params_info.replace(" ", "").split(","), camera.params, strict=True):
            setattr(self, {"f": "fx", "k": "k1"}.get(name, name), value)


class SceneManager:
    """A COLMAP model with the attributes that gsplat's parser reads.

    Attributes:
        cameras: Cameras by id.
        images: Registered images by id.
        name_to_image_id: Id of each image by name.
        points3D: World points. [P, 3]
        point3D_colors: Their colours. [P, 3] uint8
        point3D_errors: Their mean reprojection errors in pixels. [P]
        point3D_id_to_point3D_idx: Row of each point by id.
        point3D_id_to_images: (image id, index of the 2D point) of each observation, by id of the point. [L, 2]
    """

    def __init__(self, colmap_results_folder: str) -> None:
        import pycolmap

        model = pycolmap.Reconstruction(colmap_results_folder)
        self.cameras = {i: Camera(camera) for i, camera in model.cameras.items()}
        self.images = {}
        for i, image in sorted(model.images.items()):
            if image.has_pose:
                pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
                matrix = np.array(pose.matrix())
                self.images[i] = Image(image.name, image.camera_id, matrix[:, :3], matrix[:, 3])
        self.name_to_image_id = {image.name: i for i, image in self.images.items()}
        points = sorted(model.points3D.items())
        self.points3D = np.array([point.xyz for _, point in points], dtype=np.float64).reshape(-1, 3)
        self.point3D_colors = np.array([point.color for _, point in points], dtype=np.uint8).reshape(-1, 3)
        self.point3D_errors = np.array([point.error for _, point in points], dtype=np.float64)
        self.point3D_id_to_point3D_idx = {i: row for row, (i, _) in enumerate(points)}
        self.point3D_id_to_images = {
            i: np.array([(e.image_id, e.point2D_idx) for e in point.track.elements]).reshape(-1, 2)
            for i, point in points
        }

    def load_cameras(self) -> None:
        """Do nothing: the constructor has read cameras, images and points."""

    load_images = load_points3D = load_cameras
