"""The gate's state beside the checkpoints that a script saves itself, found again when it loads one."""

from __future__ import annotations

import functools
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.files import write_aside
from skipgs_plug.gate import SkipGate

REPLACED = ("torch.save", "torch.load")  # by `watch`; `torch.load` by `run_script` too
SUFFIX = ".skipgs.json"  # behind the name of the checkpoint


class Checkpoints:
    """For each file that the script gives to `torch.save` while it trains, a second one with the gate's state.

    When the script loads such a file with `torch.load` and goes on in the iteration after it, the gate goes on
    too. A state of another script or iteration is left alone, and that is said.

    Args:
        adapter: Name of the adapter.
        script: What is run, without its arguments and folder.
        resume: "auto"; "off" for a gate that starts afresh; or the path of a state to go on from.

    Raises:
        SkipGSError: The given path holds no state.
    """

    def __init__(self, adapter: str, script: str, resume: str = "auto") -> None:
        self.gate: SkipGate | None = None
        self._run = {"adapter": adapter, "script": script}
        self._search = resume == "auto"
        self._given = None if resume in ("auto", "off") else Path(resume)
        self._found: list[Path] = []
        self._without: list[Path] = []  # checkpoints that were loaded and have no state beside them
        if self._given is not None:
            _read(self._given)

    @contextmanager
    def watch(self) -> Iterator[None]:
        """See what is saved and loaded inside the block."""
        save, load = torch.save, torch.load

        @functools.wraps(save)
        def save_both(obj: Any, f: Any, *args: Any, **kwargs: Any) -> None:
            save(obj, f, *args, **kwargs)
            if isinstance(f, (str, os.PathLike)):
                self._save_beside(Path(f))

        @functools.wraps(load)
        def load_and_remember(f: Any, *args: Any, **kwargs: Any) -> Any:
            if self._search and isinstance(f, (str, os.PathLike)):
                beside = _beside(Path(f))
                (self._found if beside.is_file() else self._without).append(beside)
            return load(f, *args, **kwargs)

        torch.save, torch.load = save_both, load_and_remember
        try:
            yield
        finally:
            torch.save, torch.load = save, load

    def state_for(self, first: int) -> dict[str, Any] | None:
        """Return the state of the gate for a script whose first iteration this is, if there is one.

        Raises:
            SkipGSError: The state that the user gave is of another iteration, or one is damaged.
        """
        if self._given is not None:
            content = _read(self._given)
            if content["gate"]["step"] != first - 1:
                raise SkipGSError(
                    f"The gate state {self._given} is of iteration {content['gate']['step']}, but the script goes on "
                    f"with {first}: give the one beside the checkpoint that it loads, or --resume-gate off."
                )
            _say(f"The gate takes its state from {self._given}.")
            return content["gate"]
        refused = ""
        for path in self._found:
            content = _read(path)
            if content["gate"]["step"] == first - 1 and {name: content[name] for name in self._run} == self._run:
                _say(f"The gate takes its state from {path}.")
                return content["gate"]
            refused = (
                f"The gate starts afresh: {path} is of {content['script']} and iteration {content['gate']['step']}, "
                f"while {self._run['script']} begins with {first}."
            )
        if not refused and self._without and first > 1:
            refused = f"The gate starts afresh in iteration {first}: there is no {self._without[-1]}."
        if refused:
            _say(refused)
        return None

    def _save_beside(self, checkpoint: Path) -> None:
        gate = self.gate
        if gate is None or not gate.config.enabled or gate.stats()["iterations"] == 0:
            return
        for state in checkpoint.parent.glob(f"*{SUFFIX}"):  # some scripts keep the last few checkpoints only
            if not state.with_name(state.name.removesuffix(SUFFIX)).exists():
                state.unlink(missing_ok=True)
        try:
            with write_aside(_beside(checkpoint)) as temporary:
                temporary.write_text(json.dumps({**self._run, "gate": gate.state_dict()}) + "\n")
        except Exception as error:  # the script's checkpoint is written, and its training goes on
            why = f"{type(error).__name__}: {error}"
            _say(f"{_beside(checkpoint)} could not be written ({why}): a run that is resumed here gates afresh.")


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
        f"{path} holds no gate state: give a file that ends in {SUFFIX}, as it lies beside the checkpoints of a gated "
        "run, or --resume-gate off."
    )


def _say(sentence: str) -> None:
    print(f"skipgs-plug: {sentence}", file=sys.stderr)
