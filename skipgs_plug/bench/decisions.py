"""decisions.json: every decision of every run, small enough to store with the results.

    {"kind": "skipgs-decisions", "schema_version": 1, "start": 1500,
     "views": {"0": "12 3 15 ..."},                          by seed: index of the view of each iteration that ran
     "runs": {"0": {"own": "-1500", "gate": "w34dD3b"}}}  by seed and policy: letters, each with its repetitions

The letters are explained in REASON_CODES. Upper case means that the backward was skipped, a point that the whole
iteration was left out. All policies of a seed see the same views in the same order. A policy with fewer iterations sees
the first of them. Losses and means are not stored.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from skipgs_plug.bench.record import LEFT_OUT, RunRecord, Trace
from skipgs_plug.trainer import InputError
from skipgs_plug.trainer.files import write_json

FILE = "decisions.json"
KIND = "skipgs-decisions"
SCHEMA_VERSION = 1  # version of the format of decisions.json


def write_decisions(path: Path, records: Sequence[RunRecord]) -> None:
    """Write the decisions of all runs that finished."""
    views: dict[int, list[int]] = {}
    runs: dict[int, dict[str, str]] = {}
    start = None
    for record in records:
        if record.status == "done" and record.trace is not None:
            start = record.trace.start
            seen = [view for view in record.trace.view if view is not None]
            views[record.seed] = max(views.get(record.seed, []), seen, key=len)
            runs.setdefault(record.seed, {})[record.policy] = packed(record.trace.codes)
    orders = {seed: " ".join(map(str, order)) for seed, order in views.items()}
    content = {"kind": KIND, "schema_version": SCHEMA_VERSION, "start": start, "views": orders, "runs": runs}
    write_json(path, content)


def read_decisions(path: Path) -> dict[tuple[int, str], Trace]:
    """Return traces without losses and means, by seed and policy.

    Raises:
        InputError: The file is damaged or of another version.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text())
        if content["kind"] != KIND or content["schema_version"] != SCHEMA_VERSION:
            raise ValueError(f"kind {content['kind']!r}, schema version {content['schema_version']!r}")
        traces = {}
        for seed, runs in content["runs"].items():
            order = [int(index) for index in content["views"][seed].split()]
            for policy, letters in runs.items():
                codes, following = unpacked(letters), iter(order)
                seen = [None if code == LEFT_OUT else next(following) for code in codes]
                traces[int(seed), policy] = Trace(content["start"], seen, codes=codes)
    except (ValueError, KeyError, TypeError, AttributeError, StopIteration) as error:
        raise InputError(f"{path} holds no decisions that can be read ({error}); repeat its bench.") from error
    return traces


def packed(codes: str) -> str:
    """Return run-length encoded letters: each letter is followed by its number of repetitions if that is above 1."""
    runs = ((letter, len(list(same))) for letter, same in groupby(codes))
    return "".join(letter if count == 1 else f"{letter}{count}" for letter, count in runs)


def unpacked(letters: str) -> str:
    """Undo `packed`.

    Raises:
        ValueError: The string is not a result of `packed`.
    """
    if not re.fullmatch(r"([a-zA-Z.-]\d*)*", letters):
        raise ValueError("letters and repetitions are mixed up")
    return re.sub(r"(.)(\d+)", lambda run: run[1] * int(run[2]), letters)
