"""Save the gate's state beside the checkpoints of a script, and restore it when the script loads one."""

from __future__ import annotations

import functools
import json
import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.files import write_aside
from skipgs_plug.gate import SkipGate
from skipgs_plug.messages import say

# Functions that `watch` replaces. `run_script` replaces `torch.load` too.
REPLACED = ("torch.save", "torch.load")
SUFFIX = ".skipgs.json"  # appended to the name of the checkpoint
TAIL = 65_536  # bytes at the end of a checkpoint; PyTorch lists the checksums of all its tensors there


class Checkpoints:
    """Writes the gate's state next to every file that the script saves with `torch.save`.

    When the script loads such a file with `torch.load` and continues with the next iteration, the gate continues
    too. If a state belongs to another script or iteration, or to an earlier file of that name, the gate ignores it and
    prints a message.

    Args:
        adapter: Name of the adapter.
        script: Name of the script or module, without its folder and arguments.
        resume: "auto" to look for a state, "off" to start afresh, or the path of the state to continue from.

    Raises:
        SkipGSError: The file at the given path does not hold a state.
    """

    def __init__(self, adapter: str, script: str, resume: str = "auto") -> None:
        self.gate: SkipGate | None = None
        self._run = {"adapter": adapter, "script": script}
        self._search = resume == "auto"
        self._given = None if resume in ("auto", "off") else Path(resume)
        self._found: list[tuple[Path, str | None]] = []  # state files, and what their checkpoints held when loaded
        self._without: list[Path] = []  # missing state files of loaded checkpoints
        if self._given is not None:
            _read(self._given)

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Follow the calls of `torch.save` and `torch.load` inside the block."""
        save, load = torch.save, torch.load

        @functools.wraps(save)
        def save_both(obj: Any, f: Any, *args: Any, **kwargs: Any) -> None:
            save(obj, f, *args, **kwargs)
            if (path := _path_of(f)) is not None:
                # An open file may hold bytes that are not written yet.
                self._save_beside(path, _contents_of(path) if isinstance(f, (str, os.PathLike)) else None)

        @functools.wraps(load)
        def load_and_remember(f: Any, *args: Any, **kwargs: Any) -> Any:
            if self._search and (path := _path_of(f)) is not None:
                beside = _beside(path)
                if beside.is_file():
                    self._found.append((beside, _contents_of(path)))
                else:
                    self._without.append(beside)
            return load(f, *args, **kwargs)

        torch.save, torch.load = save_both, load_and_remember
        try:
            yield
        finally:
            torch.save, torch.load = save, load

    def state_for(self, first: int) -> dict[str, Any] | None:
        """Return the gate's state for a script that starts with iteration `first`; None if there is no such state.

        Raises:
            SkipGSError: The state that the user gave belongs to another iteration, or a state is damaged.
        """
        if self._given is not None:
            content = _read(self._given)
            if content["gate"]["step"] != first - 1:
                raise SkipGSError(
                    f"The gate state {self._given} belongs to iteration {content['gate']['step']}, but the script "
                    f"continues with iteration {first}: give the state beside the checkpoint that the script loads, "
                    "or --resume-gate off."
                )
            say(f"The gate takes its state from {self._given}.")
            return content["gate"]
        refused = ""
        for path, checkpoint in self._found:
            content = _read(path)
            if content.get("checkpoint") not in (None, checkpoint):
                refused = f"The gate starts afresh: {path} was saved beside another checkpoint of that name."
                continue
            if content["gate"]["step"] == first - 1 and {name: content[name] for name in self._run} == self._run:
                say(f"The gate takes its state from {path}.")
                return content["gate"]
            refused = (
                f"The gate starts afresh: {path} belongs to iteration {content['gate']['step']} of "
                f"{content['script']}, but {self._run['script']} starts with iteration {first}."
            )
        if not refused and self._without and first > 1:
            refused = f"The gate starts afresh in iteration {first}: {self._without[-1]} does not exist."
        if refused:
            say(refused)
        return None

    def _save_beside(self, checkpoint: Path, contents: str | None) -> None:
        gate = self.gate
        try:
            if gate is None or not gate.config.enabled or gate.stats()["iterations"] == 0:
                return
            for older in checkpoint.parent.glob(f"*{SUFFIX}"):  # some scripts delete their older checkpoints
                if older.is_file() and not older.with_name(older.name.removesuffix(SUFFIX)).exists():
                    older.unlink(missing_ok=True)
            with write_aside(_beside(checkpoint)) as temporary:
                state = {**self._run, "checkpoint": contents, "gate": gate.state_dict()}
                temporary.write_text(json.dumps(state) + "\n")
        except Exception as error:  # the script has its checkpoint and can continue to train
            why = f"{type(error).__name__}: {error}"
            say(f"{_beside(checkpoint)} could not be written ({why}): if a run resumes here, its gate starts afresh.")


def _path_of(file: Any) -> Path | None:
    """Return the path of a file that a script saves or loads, by its path or as an open file; None if it has none."""
    name = file if isinstance(file, os.PathLike) else getattr(file, "name", file)
    return Path(name) if isinstance(name, (str, os.PathLike)) else None


def _contents_of(checkpoint: Path) -> str | None:
    """Return a text by which the contents of two checkpoints differ; None if the file cannot be read."""
    try:
        with open(checkpoint, "rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - TAIL, 0))
            return f"{size} bytes, {zlib.crc32(file.read()):08x}"
    except OSError:
        return None


def _beside(checkpoint: Path) -> Path:
    return checkpoint.with_name(checkpoint.name + SUFFIX)


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
        if {"adapter", "script"} <= content.keys() and "step" in content["gate"]:
            return content
    except (OSError, ValueError, AttributeError, KeyError, TypeError, RecursionError):
        pass
    raise SkipGSError(
        f"{path} does not hold a gate state: give a file that ends in {SUFFIX}, from beside the checkpoints of a gated "
        "run, or --resume-gate off."
    )
