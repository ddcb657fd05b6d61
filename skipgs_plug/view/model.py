"""Models in a run folder or a file, by iteration, and the scene that they were trained on."""

from __future__ import annotations

import pickle
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from skipgs_plug.trainer.config import TrainConfig
from skipgs_plug.trainer.errors import InputError, MissingFileError
from skipgs_plug.trainer.frame import Frame, frame_of
from skipgs_plug.trainer.loaders import load_scene
from skipgs_plug.trainer.near_plane import far_plane, near_plane
from skipgs_plug.trainer.ply import read_ply, renderable
from skipgs_plug.trainer.run_folder import SCENE
from skipgs_plug.trainer.scene import BLACK, Scene
from skipgs_plug.view.splat import read_splat
from skipgs_plug.view.spz import read_spz

# Where trainers write their models: this package and gsplat, then the Inria family. If an iteration has several files,
# the last pattern wins, since its format is read fastest.
MODEL_FILES = ("ckpts/ckpt_*_rank0.pt", "point_cloud/iteration_*/point_cloud.ply", "ply/point_cloud_*.ply")
LOADING = ("test_every", "init_num_pts", "init_ply")  # settings that change how a scene is loaded
NEAR_PLANE = 0.01  # near clipping plane of a PLY without a scene, in its units; gsplat's default
FILES: dict[str, Callable[[Path], dict[str, Tensor]]] = {
    ".ply": read_ply,  # plain or compressed
    ".splat": read_splat,
    ".spz": lambda path: read_spz(path).splats,
}
NUMBER = re.compile(r"(?:ckpt|point_cloud|iteration)_(\d+)")


@dataclass(frozen=True)
class Snapshot:
    """The model after an iteration; `step` is None for a single file."""

    step: int | None
    path: Path

    def load(self) -> dict[str, Tensor]:
        """Return the raw parameters `means scales quats opacities sh0 shN` in coordinates of the dataset.

        Positions are float64 where float32 would lose some.

        Raises:
            InputError: The file is damaged or not a model.
        """
        read = FILES.get(self.path.suffix.lower())
        if read is not None:
            return read(self.path)
        try:
            content = torch.load(self.path, map_location="cpu", weights_only=True)
            splats = content["splats"]
            frame = frame_of(content.get("scene", {}))
            splats = {name: splats[name] for name in ("means", "scales", "quats", "opacities", "sh0", "shN")}
        except (RuntimeError, pickle.UnpicklingError, EOFError, KeyError, TypeError, OSError, ValueError) as error:
            raise InputError(f"Checkpoint {self.path} is damaged or not one of this trainer; remove it.") from error
        return renderable(frame.dataset_splats(splats), self.path)


@dataclass
class Model:
    """Snapshots by iteration, the scene if it is known, and the settings that change how a model looks.

    Attributes:
        near_plane: Near plane of the training, or one that suits the scene.
        antialiased: Whether the model was trained with antialiasing.
        exposure: Whether each photograph differs from the model by an exposure of its own.
        far_plane: Far plane of the training.
    """

    name: str
    snapshots: list[Snapshot]
    scene: Scene | None
    near_plane: float = NEAR_PLANE
    antialiased: bool = False
    exposure: bool = False
    far_plane: float = TrainConfig.far_plane
    _frame: Frame | None = field(default=None, repr=False)

    def load(self, snapshot: Snapshot) -> dict[str, Tensor]:
        """Return the raw parameters of a snapshot in the coordinates of the scene's cameras, float32.

        Without a scene, all snapshots are moved to the origin alike if float32 would lose precision.
        """
        splats = snapshot.load()
        if self._frame is None:
            self._frame = self.scene.frame if self.scene else Frame.around(splats["means"].numpy())
        return self._frame.local_splats(splats)

    @property
    def background(self) -> tuple[float, float, float]:
        """Colour in [0, 1] behind the model."""
        return self.scene.background if self.scene else BLACK


def open_model(path: str | Path, scene: str | None = None, data_factor: int | None = None) -> Model:
    """Open a run folder, or a PLY, .splat or .spz of any trainer.

    Args:
        scene: Scene to use instead of the one that the run folder names.
        data_factor: Factor by which its images are reduced. Default: as in training, 1 for a file.

    Raises:
        MissingFileError: The file does not exist, the folder holds no model, or its scene is gone.
        InputError: A file is damaged, or the factor is out of its range.
    """
    path = Path(path).expanduser()
    snapshots = open_snapshots(path)
    config = read_config(path) if path.is_dir() else {}
    source = scene or config.get("data_dir")
    settings = TrainConfig(
        data_factor=config.get("data_factor", 1) if data_factor is None else data_factor,
        near_plane=config.get("near_plane"),
        far_plane=float(config.get("far_plane", TrainConfig.far_plane)),
    )
    loaded = None
    if source:
        if not scene and not Path(source).exists() and (path / SCENE).is_dir():
            source = path / SCENE  # the run was moved together with it
        if not scene and not Path(source).exists():
            raise MissingFileError(f"{path} was trained on {source}, which does not exist here; add --scene.")
        loaded = load_scene(source, settings.data_factor, **{name: config[name] for name in LOADING if name in config})
    return Model(
        path.stem,
        snapshots,
        loaded,
        near_plane(settings, loaded) if loaded else NEAR_PLANE,
        is_antialiased(path, config),
        bool(config.get("exposure", False)),
        far_plane(settings, loaded) if loaded else settings.far_plane,
    )


def is_antialiased(path: Path, config: Mapping[str, Any] | None = None) -> bool:
    """Whether a run folder or a file says that its model was trained with antialiasing."""
    if path.suffix.lower() == ".spz" and path.is_file():
        return read_spz(path).antialiased
    settings = read_config(path) if config is None and path.is_dir() else config or {}
    return bool(settings.get("antialiased", False))


def open_snapshots(path: str | Path) -> list[Snapshot]:
    """Return the models of a run folder by iteration, or the model of a file, without their scene.

    Raises:
        MissingFileError: The file does not exist, or the folder holds no model.
        InputError: The file has none of the endings in `FILES`.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise MissingFileError(f"{path} does not exist; give a run folder or a PLY, .splat or .spz.")
    if path.is_dir():
        return find_snapshots(path)
    if path.suffix.lower() not in FILES:
        raise InputError(f"{path} is neither a run folder nor a file that is read here ({', '.join(FILES)}).")
    return [Snapshot(None, path)]


def find_snapshots(folder: Path) -> list[Snapshot]:
    """Return the models of a run folder, by iteration.

    Raises:
        MissingFileError: The folder holds no model.
    """
    found = {}
    for pattern in MODEL_FILES:
        for path in folder.glob(pattern):
            number = NUMBER.search(path.relative_to(folder).as_posix())
            if number:
                step = int(number.group(1))
                found[step] = Snapshot(step, path)
    if not found:
        raise MissingFileError(
            f"{folder} holds no model ({', '.join(MODEL_FILES)}); give a run folder or a PLY, .splat or .spz."
        )
    return [found[step] for step in sorted(found)]


def read_config(folder: Path) -> Mapping[str, Any]:
    """Return the content of cfg.yml. It is empty for other trainers, which have another format or no such file."""
    import yaml

    file = folder / "cfg.yml"
    if not file.is_file():
        return {}
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError):
        return {}  # gsplat's holds Python objects
    return content if isinstance(content, dict) else {}
