"""The whole state of a Trainer as one dict of tensors and plain values: snapshot, checkpoint, resume."""

from __future__ import annotations

import copy
import dataclasses
import logging
import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from skipgs_plug.trainer.errors import InputError, MissingFileError
from skipgs_plug.trainer.files import write_aside

if TYPE_CHECKING:
    from skipgs_plug.trainer.loop import Trainer

log = logging.getLogger(__name__)

VERSION = 1
FREE_FIELDS = ("data_dir", "result_dir", "backend")  # may differ between a run and its continuation


def capture(trainer: Trainer) -> dict[str, Any]:
    """Return an independent copy of everything that the next iteration depends on.

    Keys: `version`, `step` (next iteration), `splats`, `optimizers` (moments by parameter), `strategy`,
    `clock` (seconds), `registered` (state_dict of each registered object). View order and split noise are
    functions of seed and step and need no entry.
    """
    moments = {}
    for name, optimizer in trainer.optimizers.items():
        moments[name] = dict(optimizer.state.get(trainer.splats[name], {}))
    state = {
        "version": VERSION,
        "step": trainer.step,
        "ran": trainer.ran,
        "splats": {name: param.detach() for name, param in trainer.splats.items()},
        "optimizers": moments,
        "strategy": dict(trainer.strategy_state),
        "clock": trainer.clock.state_dict(),
        "registered": {name: owner.state_dict() for name, owner in trainer.registered.items()},
    }
    return copy.deepcopy(state)


def apply(trainer: Trainer, state: dict[str, Any]) -> None:
    """Put a captured state back, keeping the optimizer objects so that attached tools stay attached.

    Registered objects without an entry (a gate attached later) are left as they are.
    """
    state = copy.deepcopy(state)
    trainer.step = state["step"]
    trainer.ran = state.get("ran", trainer.step)  # before iterations could be left out, all had run
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


def save_checkpoint(trainer: Trainer, path: str | Path) -> None:
    """Write the captured state with config and view names; loads with `weights_only=True`."""
    content = {
        **capture(trainer),
        "config": dataclasses.asdict(trainer.config),
        "scene": {"name": trainer.scene.name, "view_names": list(trainer.view_names)},
    }
    with write_aside(path) as temporary:
        torch.save(content, temporary)


def load_checkpoint(trainer: Trainer, path: str | Path) -> None:
    """Continue where a checkpoint of the same scene and settings stopped.

    Raises:
        MissingFileError: no such file.
        InputError: damaged, of another scene, made with other settings, or with NaN values.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingFileError(f"Checkpoint {path} does not exist; give a ckpts/ckpt_*.pt or start without --resume.")
    try:
        content = torch.load(path, map_location=trainer.backend.device, weights_only=True)
        version, splats, config = content["version"], content["splats"], content["config"]
        views = content["scene"]["view_names"]
    except (
        RuntimeError,
        pickle.UnpicklingError,
        EOFError,
        KeyError,
        TypeError,
        OSError,
        ValueError,
    ) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"Checkpoint {path} is damaged or not one of this trainer ({reason}); use an older one or start afresh."
        ) from error
    if version != VERSION:
        raise InputError(f"Checkpoint {path} has version {version}, expected {VERSION}; start afresh.")
    if views != list(trainer.view_names):
        raise InputError(f"Checkpoint {path} was made with other training views; resume with its own scene and split.")
    for name, value in dataclasses.asdict(trainer.config).items():
        if name not in FREE_FIELDS and config.get(name) != value:
            raise InputError(
                f"Checkpoint {path} was made with {name}={config.get(name)!r}, not {value!r}; resume with its settings."
            )
    for name, tensor in splats.items():
        if not torch.isfinite(tensor).all():
            raise InputError(f"Checkpoint {path} holds NaN or infinite {name}; use an older one or start afresh.")
    apply(trainer, content)
    for name in trainer.registered:
        if name not in content["registered"]:
            log.warning("Checkpoint %s holds no state for %s: it starts fresh.", path, name)
