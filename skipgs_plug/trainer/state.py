"""The whole state of a Trainer as one dict of tensors and plain values: snapshot, checkpoint, resume."""

from __future__ import annotations

import copy
import dataclasses
import logging
import pickle
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, TypedDict

import torch
from torch import Tensor, nn

from skipgs_plug import schema
from skipgs_plug.files import write_aside
from skipgs_plug.trainer.backend import Backend
from skipgs_plug.trainer.clock import TrainClock
from skipgs_plug.trainer.config import TrainConfig
from skipgs_plug.trainer.errors import DamagedCheckpointError, InputError, MissingFileError
from skipgs_plug.trainer.frame import SAME, frame_of
from skipgs_plug.trainer.ply import saturated
from skipgs_plug.trainer.scene import Scene

log = logging.getLogger(__name__)

VERSION = 1  # version of the format of checkpoints; a checkpoint with another one is refused
MOMENTS = {"step", "exp_avg", "exp_avg_sq"}
# Settings that may differ between a run and its continuation; `_require_same_run` treats the two lengths.
FREE_FIELDS = ("data_dir", "result_dir", "backend", "max_steps", "schedule_steps")
BEFORE = {"clear_depth": 0.0}  # settings that had no effect before they existed
# Errors from reading damaged bytes. A damaged byte may be part of a length, a key, a decoder or an attribute.
DAMAGE = (
    *(pickle.UnpicklingError, zipfile.BadZipFile, EOFError, OSError, MemoryError, OverflowError),
    *(RuntimeError, ValueError, TypeError, LookupError, AttributeError, AssertionError),
)


class Stateful(Protocol):
    """An object whose state is part of snapshots and checkpoints."""

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


class Capturable(Protocol):
    """The part of a `Trainer` that snapshots and checkpoints use."""

    step: int
    ran: int
    max_steps: int
    config: TrainConfig
    scene: Scene
    backend: Backend
    clock: TrainClock
    view_names: list[str]
    strategy_state: dict[str, Any]
    registered: dict[str, Stateful]

    @property
    def splats(self) -> nn.ParameterDict: ...

    @property
    def optimizers(self) -> dict[str, torch.optim.Optimizer]: ...


class ConfigEntry(TypedDict):
    """Settings that every checkpoint has: length of the run and of its schedule."""

    max_steps: int
    schedule_steps: int


class SceneEntry(TypedDict):
    """Facts about the scene in a checkpoint."""

    name: str
    view_names: list[str]


class Checkpoint(TypedDict):
    """Content of a checkpoint file: the result of `capture` with config and scene."""

    version: int
    step: int
    ran: int
    splats: dict[str, Tensor]
    optimizers: dict[str, dict[str, Tensor]]
    strategy: dict[str, Tensor | float | None]
    clock: dict[str, float]
    registered: dict[str, dict[str, Any]]
    config: ConfigEntry
    scene: SceneEntry


def capture(trainer: Capturable) -> dict[str, Any]:
    """Return an independent copy of everything that the next iteration depends on.

    Keys: `version`, `step` (next iteration), `ran` (number of iterations that ran), `splats`, `optimizers` (moments by
    parameter), `strategy`, `clock` (seconds), `registered` (state_dict of each registered object). View order and split
    noise need no entry, since they are functions of seed, `step` and `ran`.
    """
    return copy.deepcopy(_view(trainer))


def apply(trainer: Capturable, state: dict[str, Any]) -> None:
    """Restore a captured state. The optimizer objects stay the same, so that attached tools stay attached.

    Registered objects without an entry, such as a gate that was attached later, do not change.
    """
    state = copy.deepcopy(state)
    trainer.step = state["step"]
    trainer.ran = state["ran"]
    for name, tensor in state["splats"].items():
        param = nn.Parameter(tensor.to(trainer.backend.device))
        trainer.splats[name] = param
        optimizer = trainer.optimizers[name]
        optimizer.state.clear()
        optimizer.param_groups[0]["params"] = [param]
        if state["optimizers"][name]:
            optimizer.state[param] = state["optimizers"][name]
    trainer.strategy_state.clear()
    trainer.strategy_state.update(state["strategy"])
    trainer.clock.load_state_dict(state["clock"])
    for name, owner in trainer.registered.items():
        if name in state["registered"]:
            owner.load_state_dict(state["registered"][name])


def save_checkpoint(trainer: Capturable, path: str | Path) -> None:
    """Write the captured state with config and scene. The file loads with `weights_only=True`.

    Raises:
        WriteError: The file cannot be written. The message says how much space it needs.
    """
    content = {
        **_view(trainer),
        "config": {**dataclasses.asdict(trainer.config), "schedule_steps": trainer.config.schedule},
        "scene": {
            "name": trainer.scene.name,
            "view_names": list(trainer.view_names),
            "viewmats": _viewmats(trainer.scene),
            "sizes": _sizes(trainer.scene),
            **trainer.scene.frame.as_dict(),
        },
    }
    size = sum(tensor.nbytes for tensor in _tensors(content))
    # Given an open file, torch keeps the reason of a failure. Given a path, it does not.
    with write_aside(path, size) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


def read_checkpoint(path: str | Path, device: torch.device) -> dict[str, Any]:
    """Return the content of a checkpoint, in which every entry has the right type.

    Raises:
        MissingFileError: The file does not exist.
        DamagedCheckpointError: An entry is missing, has another type, or holds NaN.
        InputError: The checkpoint has another version.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"Checkpoint {path} does not exist; give a ckpts/ckpt_*.pt or start without --resume.")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
        if isinstance(content, Mapping) and isinstance(content.get("version"), int) and content["version"] != VERSION:
            raise InputError(f"Checkpoint {path} has version {content['version']}, expected {VERSION}; start afresh.")
        schema.check(content, Checkpoint, "checkpoint")
        if {"opacities", "scales"} <= content["splats"].keys():
            content["splats"] = saturated(content["splats"], path)
        _check_tensors(content)
    except InputError:
        raise
    except DAMAGE as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DamagedCheckpointError(
            f"Checkpoint {path} is damaged or not one of this trainer ({reason}); use an older one or start afresh."
        ) from error
    return content


def load_checkpoint(trainer: Capturable, path: str | Path) -> None:
    """Continue from a checkpoint of the same scene and settings.

    Raises:
        MissingFileError: The file does not exist.
        DamagedCheckpointError: The checkpoint is damaged or holds NaN.
        InputError: The checkpoint is of another scene, or made with other settings.
    """
    content = read_checkpoint(path, trainer.backend.device)
    _require_same_run(trainer, content, path)
    _require_same_shape(trainer, content, path)
    content = _in_local_coordinates(content, trainer.scene)
    try:
        apply(trainer, content)
    except InputError:
        raise
    except DAMAGE as error:  # a registered object refuses its state
        raise DamagedCheckpointError(f"Checkpoint {path} cannot be continued: {error}") from error
    for name in trainer.registered:
        if name not in content["registered"]:
            log.warning("Checkpoint %s holds no state for %s: it starts fresh.", path, name)


def _view(trainer: Capturable) -> dict[str, Any]:
    """Return the content of `capture` without copying tensors."""
    moments = {}
    for name, optimizer in trainer.optimizers.items():
        moments[name] = dict(optimizer.state.get(trainer.splats[name], {}))
    return {
        "version": VERSION,
        "step": trainer.step,
        "ran": trainer.ran,
        "splats": {name: param.detach() for name, param in trainer.splats.items()},
        "optimizers": moments,
        "strategy": dict(trainer.strategy_state),
        "clock": trainer.clock.state_dict(),
        "registered": {name: owner.state_dict() for name, owner in trainer.registered.items()},
    }


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, dict):
        for entry in value.values():
            yield from _tensors(entry)


def _check_tensors(content: dict[str, Any]) -> None:
    """Raise SchemaError unless all tensors are finite and have the same number of rows."""
    splats = content["splats"]
    n = {len(tensor) if tensor.ndim else -1 for tensor in splats.values()}
    if len(n) != 1 or min(n) < 1:
        raise schema.SchemaError("its parameters are of different lengths, or empty")
    if content["optimizers"].keys() != splats.keys():
        raise schema.SchemaError("its optimizers are not those of its parameters")
    for name, moments in content["optimizers"].items():
        if moments and moments.keys() != MOMENTS:
            raise schema.SchemaError(f"moments of {name} are {', '.join(sorted(moments))}")
        for key, moment in moments.items():
            if moment.shape != (() if key == "step" else splats[name].shape) or not moment.is_floating_point():
                raise schema.SchemaError(f"{key} of {name} is {moment.dtype} of shape {list(moment.shape)}")
            if not torch.isfinite(moment).all():
                raise schema.SchemaError(f"it holds NaN or infinite {key} of {name}")
    for name, tensor in splats.items():
        if not torch.isfinite(tensor).all():
            raise schema.SchemaError(f"it holds NaN or infinite {name}")
    for name, value in content["strategy"].items():
        if isinstance(value, Tensor) and value.shape != (*n,):
            raise schema.SchemaError(f"{name} of the strategy has shape {list(value.shape)}")


def _require_same_run(trainer: Capturable, content: dict[str, Any], path: str | Path) -> None:
    if content["scene"]["view_names"] != list(trainer.view_names):
        raise InputError(f"Checkpoint {path} was made with other training views; resume with its own scene and split.")
    _require_same_cameras(trainer.scene, content["scene"], path)
    _require_same_sizes(trainer.scene, content["scene"], path)
    # A checkpoint that is older than a setting was made with the present default, or without the effect that it has.
    present = {field.name: field.default for field in dataclasses.fields(TrainConfig)}
    made_with = present | BEFORE | content["config"]
    for name, value in dataclasses.asdict(trainer.config).items():
        if name not in FREE_FIELDS and made_with[name] != value:
            raise InputError(
                f"Checkpoint {path} was made with {name}={made_with[name]!r}, not {value!r}; resume with its settings."
            )
    schedule = made_with["schedule_steps"]
    if schedule != trainer.config.schedule:
        raise InputError(
            f"Checkpoint {path} was made on a schedule of {schedule} iterations, not {trainer.config.schedule}; "
            f"resume with max_steps={schedule}, or extend it with schedule_steps={schedule} and a larger max_steps."
        )
    if content["step"] > trainer.max_steps:
        raise InputError(
            f"Checkpoint {path} is {content['step']} iterations old, more than max_steps={trainer.max_steps}; "
            "give at least as many."
        )


def _in_local_coordinates(content: dict[str, Any], scene: Scene) -> dict[str, Any]:
    """Return the content of a checkpoint in local coordinates. Up to 0.1.0, checkpoints use those of the dataset."""
    if frame_of(content["scene"]).moves or not scene.frame.moves:
        return content
    unit = scene.frame.unit
    moments = dict(content["optimizers"]["means"])
    for key, power in (("exp_avg", 1), ("exp_avg_sq", 2)):  # moments of gradients, which grow with the unit
        if key in moments:
            moments[key] = moments[key] * unit**power
    strategy = content["strategy"]
    if "scene_scale" in strategy:
        strategy = {**strategy, "scene_scale": scene.scene_scale}
    return {
        **content,
        "splats": scene.frame.local_splats(content["splats"]),
        "optimizers": {**content["optimizers"], "means": moments},
        "strategy": strategy,
    }


def _require_same_cameras(scene: Scene, saved: Mapping[str, Any], path: str | Path) -> None:
    """Raise InputError if the checkpoint was trained with other cameras or in another frame than the scene's."""
    try:
        frame = frame_of(saved)
    except (TypeError, ValueError, KeyError) as error:
        raise DamagedCheckpointError(f"Checkpoint {path} is damaged ({error}); use an older one.") from error
    if frame.moves and not frame.is_like(scene.frame, scene.scene_scale):
        raise InputError(
            f"Checkpoint {path} was trained in the frame {frame.as_dict()}, but the frame of the scene is now "
            f"{scene.frame.as_dict()}; resume with the scene as it was, or begin a new run with --init-ply and the PLY "
            "of this one."
        )
    poses = saved.get("viewmats")  # not in checkpoints of version 0.1.0
    if poses is None:
        return
    own = _viewmats(scene)
    if not isinstance(poses, Tensor) or poses.shape != own.shape:
        raise DamagedCheckpointError(
            f"Checkpoint {path} is damaged (its cameras have another shape); use an older one."
        )
    poses = poses.cpu().double()
    if not frame.moves:
        poses = torch.stack([scene.frame.local_pose(pose) for pose in poses])
    apart = (poses - own).abs()
    apart[:, :3, 3] /= scene.scene_scale
    changed = (apart.amax(dim=(1, 2)) > SAME).nonzero()[:, 0].tolist()
    if changed:
        raise InputError(
            f"Checkpoint {path} was trained with other poses of {len(changed)} of its {len(own)} cameras, such as "
            f"{scene.train[changed[0]].name!r}; resume with the reconstruction it was begun with, or start afresh."
        )


def _require_same_sizes(scene: Scene, saved: Mapping[str, Any], path: str | Path) -> None:
    """Raise InputError if the checkpoint was trained with photographs of other sizes. Up to 0.2.0 it does not tell."""
    if "sizes" not in saved:
        return
    sizes, own = saved["sizes"], _sizes(scene)
    if not isinstance(sizes, Tensor) or sizes.shape != own.shape:
        raise DamagedCheckpointError(f"Checkpoint {path} is damaged (its sizes have another shape); use an older one.")
    changed = (sizes.cpu() != own).any(dim=1).nonzero()[:, 0].tolist()
    if changed:
        (width, height), (own_width, own_height) = sizes[changed[0]].tolist(), own[changed[0]].tolist()
        raise InputError(
            f"Checkpoint {path} was trained with photographs of another size: {scene.train[changed[0]].name!r} had "
            f"{width}x{height} pixels, and has {own_width}x{own_height}; resume with those it was begun with, "
            "or start afresh."
        )


def _sizes(scene: Scene) -> Tensor:
    """Return width and height [C, 2] of the training views, in pixels."""
    return torch.tensor([[view.width, view.height] for view in scene.train])


def _viewmats(scene: Scene) -> Tensor:
    """Return the poses [C, 4, 4] of the training views."""
    return torch.stack([view.viewmat for view in scene.train]).double().cpu()


def _require_same_shape(trainer: Capturable, content: dict[str, Any], path: str | Path) -> None:
    """Raise DamagedCheckpointError unless the trainer has the same parameters and entries."""
    wrong = _difference(trainer, content)
    if wrong is not None:
        raise DamagedCheckpointError(
            f"Checkpoint {path} is damaged or not one of this trainer ({wrong}); use an older one or start afresh."
        )


def _difference(trainer: Capturable, content: dict[str, Any]) -> str | None:
    own = {name: (list(param.shape[1:]), param.dtype) for name, param in trainer.splats.items()}
    read = {name: (list(tensor.shape[1:]), tensor.dtype) for name, tensor in content["splats"].items()}
    if own != read:
        return f"parameters {read}, not {own}"
    if content["strategy"].keys() != trainer.strategy_state.keys():
        return f"strategy {sorted(content['strategy'])}"
    for name, value in content["strategy"].items():
        if isinstance(value, (int, float)) != isinstance(trainer.strategy_state[name], (int, float)):
            return f"{name} of the strategy is {type(value).__name__}"
    if not TrainClock.can_load(content["clock"]):
        return f"clock {sorted(content['clock'])}"
    return None
