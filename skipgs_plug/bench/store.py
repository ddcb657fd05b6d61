"""The folder of a bench. Each finished run is stored at once, so that a killed bench can continue."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from skipgs_plug.bench.record import RunRecord
from skipgs_plug.files import BENCH_SETTINGS
from skipgs_plug.trainer import InputError
from skipgs_plug.trainer.files import write_aside, write_json
from skipgs_plug.trainer.run_folder import RunFolder


class BenchFolder:
    """Names and writes `settings.json`, `snapshots/`, `runs/`, `tb/` and `bench.json`."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).expanduser()

    def require_settings(self, settings: dict[str, Any]) -> None:
        """Store the settings of a new folder; an existing folder must have the same settings.

        Seeds and policies do not count as settings: a folder may get more of them later.

        Raises:
            InputError: The folder holds a training run, or a bench with other settings. The message names a file, or
                the first difference.
        """
        path = self.root / BENCH_SETTINGS
        if not path.is_file():
            run = RunFolder(self.root)
            files = [*run.checkpoints(), *run.results()]
            if files:
                raise InputError(f"{self.root} holds a training run ({files[0]}), not a bench; give another --out.")
            write_json(path, settings)
            return
        stored = read_json(path)
        for name, value in flat(settings).items():
            if flat(stored).get(name) != value:
                raise InputError(
                    f"{self.root} holds a bench with {name}={flat(stored).get(name)!r}, not {value!r}; "
                    "use its settings or give another --out."
                )

    def snapshot(self, seed: int) -> Path:
        """Return the path of the checkpoint of a densified seed."""
        return self.root / "snapshots" / f"seed{seed}.pt"

    def scalars(self, seed: int, name: str) -> Path:
        """Return the folder of the TensorBoard scalars of a run, or of a seed's densification."""
        return self.root / "tb" / f"seed{seed}_{name}"

    def load(self, seed: int, policy: str) -> RunRecord | None:
        """Return a finished run; None if it has not finished."""
        path = self._run(seed, policy)
        if not path.is_file():
            return None
        try:
            return RunRecord.from_dict(read_json(path))
        except (KeyError, TypeError) as error:
            raise InputError(f"{path} is not a run of a bench ({error}); remove it to repeat the run.") from error

    def store(self, record: RunRecord) -> None:
        with write_aside(self._run(record.seed, record.policy)) as temporary:
            temporary.write_text(
                json.dumps(record.as_dict(), separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8"
            )

    def _run(self, seed: int, policy: str) -> Path:
        return self.root / "runs" / f"seed{seed}_{policy}.json"


def read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(f"{path} cannot be read as JSON ({error}); restore it or remove it.") from error


def flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings as one dict with dotted names."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            found.update(flat(value, f"{prefix}{name}."))
        else:
            found[prefix + name] = value
    return found
