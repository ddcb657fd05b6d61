"""The content of bench.json: settings, provenance, all runs without traces, and the table, as plain values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from skipgs_plug.bench import provenance
from skipgs_plug.bench.record import RunRecord
from skipgs_plug.bench.runner import Bench
from skipgs_plug.bench.summary import ceiling, row_as_dict, summarise, timing_noise

SCHEMA_VERSION = 2  # version of the format of bench.json
KIND = "skipgs-bench"


def build_result(bench: Bench, records: Sequence[RunRecord], command: str) -> dict[str, Any]:
    """Return the content of bench.json.

    Returns:
        `kind`, `schema_version`; `command`, `commits`, `versions`; `settings` (training, scene, machine, lpips, clock,
        whole); `seeds`, `policies`; `refinement` (first iteration, last iteration + 1); `view_names` (traces hold
        indices into it); `rows` (means and spreads); `ceiling`, `timing_noise` (see summary; None for whole runs, whose
        models differ); `runs` (records without traces). Traces are in runs/ and, without losses, in decisions.json.
    """
    last = bench.config.max_steps
    first = bench.refine_stop_iter
    rows = summarise(records, bench.policies, last if bench.whole else last - first, bench.whole)
    return {
        "kind": KIND,
        "schema_version": SCHEMA_VERSION,
        "command": command,
        "commits": sorted({record.commit or "unknown" for record in records}),
        "versions": provenance.versions(),
        "settings": bench.settings,
        "seeds": bench.seeds,
        "policies": bench.policies,
        "refinement": [first, last],
        "view_names": [view.name for view in bench.scene.train],
        "rows": [row_as_dict(row) for row in rows],
        "ceiling": None if bench.whole else ceiling(rows),
        "timing_noise": None if bench.whole else timing_noise(records),
        "runs": [record.as_dict(with_trace=False) for record in records],
    }
