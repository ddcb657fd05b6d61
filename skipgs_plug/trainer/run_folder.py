"""The run folder, in gsplat's layout."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from skipgs_plug.files import remove_leftovers, write_aside
from skipgs_plug.trainer.files import write_json
from skipgs_plug.trainer.loop import Trainer
from skipgs_plug.trainer.scene import View

CHECKPOINT = re.compile(r"ckpt_(\d+)_rank0\.pt")
SCENE = "scene"  # subfolder with the scene that `train --sfm` reconstructed
RESULTS = ("ply/point_cloud_*.ply", "skipgs.json", "stats/*.json", "renders/*_step*.png")
KEPT = 2  # checkpoints to keep: the older one serves if the last is damaged
MOST_WAITING = 2  # renders that may wait for a slow disk, which bounds memory
FOLDERS = ("", "ckpts", "ply", "stats", "renders")


class RunFolder:
    """Writes the files of a run. File names carry the last finished iteration, from 0."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).expanduser()

    def write_config(self, trainer: Trainer, gate: dict[str, Any] | None) -> None:
        """Write cfg.yml: the settings, those that others decide too, the frame, and the gate's settings.

        The near plane is in units of the dataset.
        """
        import yaml

        frame = trainer.scene.frame
        content = {
            **dataclasses.asdict(trainer.config),
            "schedule_steps": trainer.config.schedule,
            "near_plane": frame.dataset_length(trainer.near_plane),
            "frame": frame.as_dict(),
            "gate": gate,
        }
        with write_aside(self.root / "cfg.yml") as temporary:
            temporary.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")

    def write_checkpoint(self, trainer: Trainer) -> Path:
        """Write a checkpoint, then remove all but the last two."""
        path = self.root / "ckpts" / f"ckpt_{trainer.step - 1}_rank0.pt"
        trainer.save_checkpoint(path)
        for old in self.checkpoints()[KEPT:]:
            old.unlink(missing_ok=True)
        return path

    def checkpoints(self) -> list[Path]:
        """Return the checkpoints, with the highest iteration first."""
        found = [
            (match, path) for path in (self.root / "ckpts").glob("*") if (match := CHECKPOINT.fullmatch(path.name))
        ]
        return [path for match, path in sorted(found, key=lambda entry: -int(entry[0][1]))]

    def results(self) -> list[Path]:
        """Return models, reports and evaluations: readers would take them for those of a run that begins here."""
        return sorted(path for pattern in RESULTS for path in self.root.glob(pattern))

    def remove_leftovers(self) -> None:
        """Remove half-written files of a killed run. No other process may be writing to the folder."""
        for name in FOLDERS:
            remove_leftovers(self.root / name)

    def write_ply(self, trainer: Trainer) -> Path:
        path = self.root / "ply" / f"point_cloud_{trainer.step - 1}.ply"
        trainer.export_ply(path)
        return path

    def write_stats(self, trainer: Trainer, stats: dict[str, Any], split: str = "val") -> Path:
        """Write an evaluation with the seconds of training that led to it; NaN is written as null."""
        seconds = {name: None if math.isnan(value) else value for name, value in trainer.clock.seconds().items()}
        path = self.root / "stats" / f"{split}_step{trainer.step - 1}.json"
        write_json(path, {**stats, **seconds})
        return path

    @contextlib.contextmanager
    def renders(self, trainer: Trainer, split: str = "val") -> Iterator[Callable[[int, View, Tensor], None]]:
        """Yield a function that writes photograph and render side by side, on a thread while the next view is rendered.

        It takes the number of a held-out (or, for "train", training) view, the view, and its render [H, W, 3].

        Raises:
            WriteError: A render could not be written, and later ones are left out. Raised at the end of the block.
        """
        waiting: deque[Future[None]] = deque()
        failed: list[BaseException] = []

        def collect(left: int) -> None:
            while len(waiting) > left:
                error = waiting.popleft().exception()
                failed.extend([] if error is None else [error])

        def keep(i: int, view: View, render: Tensor) -> None:
            collect(MOST_WAITING)
            if not failed:
                path = self.root / "renders" / f"{split}_step{trainer.step - 1}_{i:04d}.png"
                waiting.append(writer.submit(write_pair, path, view.image, render.detach().cpu()))

        with ThreadPoolExecutor(1) as writer:
            yield keep
            collect(0)
        if failed:
            raise failed[0]


def write_pair(path: Path, photograph: Tensor, render: Tensor) -> None:
    """Write a photograph [H, W, 3] uint8 and its render [H, W, 3] in [0, 1] side by side as a PNG."""
    from PIL import Image

    shown = (render.clamp(0, 1) * 255).round().byte()
    pair = Image.fromarray(np.concatenate([photograph.numpy(), shown.numpy()], axis=1))
    with write_aside(path) as temporary:
        pair.save(temporary, format="PNG", compress_level=1)  # a third of the time, for 5 % more bytes
