"""Write JSON files aside. `write_aside` is in `skipgs_plug.files`, for all parts of the package."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from skipgs_plug.files import write_aside


def write_json(path: str | Path, content: Any) -> None:
    with write_aside(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
