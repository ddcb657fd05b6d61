"""Look-alikes of all adapters on a simulated second device: nothing mixes devices, and host reads are few.

Each day five look-alikes are tested. `pytest tests/device --all-lookalikes` tests all of them.
"""

from __future__ import annotations

import datetime
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.device.turns import chosen

HERE = Path(__file__).parent
LOOKS = 5  # skipped iterations in which the drift check reads once
MUTANTS = {
    "loss read twice": ("inria", "gsplat_default"),
    "loss meets a tensor of the host": ("inria", "gsplat_default"),
    "loss through numpy": ("inria", "gsplat_default"),
    "boolean mask": ("inria", "gsplat_default"),
    "buffer of the host in a step hook": ("inria", "gsplat_default"),
}


def has_backend() -> bool:
    """Whether this PyTorch lets a backend be written in Python."""
    try:
        from torch.utils import backend_registration

        return hasattr(backend_registration, "_setup_privateuseone_for_python_backend")
    except ImportError:
        return False


LONGEST = 1800  # time limit in seconds: all look-alikes take longer than the 300 s of other tests
pytestmark = [
    pytest.mark.timeout(LONGEST),
    pytest.mark.skipif(
        not has_backend(), reason=f"torch {torch.__version__} has no backends in Python; 2.9 and later have"
    ),
]


def on_sim(*args: str) -> dict[str, Any]:
    """Host reads by mutant ("" for none), look-alike and settings; in a process of its own."""
    done = subprocess.run(
        [sys.executable, str(HERE / "lookalikes_on_sim.py"), *args], capture_output=True, text=True, timeout=LONGEST
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def reads(request) -> dict[str, dict[str, Any]]:
    turn = "all" if request.config.getoption("--all-lookalikes") else str(datetime.date.today().toordinal())
    return on_sim("--turn", turn)[""]  # type: ignore[no-any-return]


# Refusals of trainers whose loops do not count with a range, or not in the trainer itself.
NO_SHARE = ("No loop over range", "cannot leave out whole iterations")


def complaints(name: str, found: dict[str, Any]) -> list[str]:
    """Return the faults of one look-alike's iterations, by settings."""
    wrong = []
    for settings, rows in found.items():
        if isinstance(rows, str):
            if not (settings == "share" and any(refusal in rows for refusal in NO_SHARE)):
                wrong.append(f"{settings}: {rows}")
            continue
        looks = 0
        for row in rows:
            count = Counts(row["gate"])
            looks += count.looks
            idle = settings == "off" or row["reason"] == "inactive"
            # The device works on while the host waits for a copy that began before a render or a backward pass. In
            # gsplat's script the gate waits for the id of the view in this way.
            id_waits = 0 if idle or name == "gsplat_batch" or not name.startswith("gsplat") else 1
            loss_reads = count.reads + count.waits - id_waits
            few = loss_reads <= (0 if idle or row["reason"] == "over" else 1)
            if not (few and count.looks <= 1 and count.visibility <= (settings == "share" and not idle)):
                wrong.append(f"{settings}, iteration {row['step']} ({row['reason']}): {row['gate']}")
        if looks > LOOKS:
            wrong.append(f"{settings}: the drift check looked {looks} times")
    return wrong


class Counts:
    """Host reads of the gate in one iteration, by their purpose."""

    def __init__(self, gate: list[tuple[str, str, int, int]]) -> None:
        self.looks = self.visibility = self.waits = self.reads = 0
        for kind, file, _, count in gate:
            if file == "core/drift_check.py":
                self.looks += count
            elif file == "core/distributed.py":
                self.visibility += count
            elif kind == "waited for a copy":
                self.waits += count
            else:
                self.reads += count


def test_every_lookalike_has_its_turn():
    """Starting from any day, the following turns reach all look-alikes."""
    names = [f"lookalike {i}" for i in range(28)]
    assert {name for day in range(100, 106) for name in chosen(names, str(day))} == set(names)
    assert chosen(names, "all") == names and len(chosen(names, "100")) == 5


def test_no_device_is_mixed_and_reads_are_few(reads):
    assert not {name: wrong for name, found in reads.items() if (wrong := complaints(name, found))}


def test_most_backwards_do_not_wait_for_the_loss(reads):
    """Warm-up, views without a mean, every iteration of refine_share: the loss is read behind the backward."""
    for name, found in reads.items():
        for row in [row for rows in found.values() if isinstance(rows, list) for row in rows]:
            if row["reason"] in ("warm-up", "new view", "pause", "full") and name not in ("fastgs", "taming_sh_lower"):
                assert not Counts(row["gate"]).reads, (name, row)


def test_the_gate_decides_there(reads):
    """Else the test above would see nothing."""
    for name, found in reads.items():
        assert any(row["skip"] for row in found["rule"]), name
        assert isinstance(found["share"], str) or any(row["reason"] == "full" for row in found["share"]), name


def test_defects_that_only_a_second_device_shows_are_caught():
    args = [part for name in MUTANTS for part in ("--mutant", name)]
    found = on_sim(*args, "--settings", "rule", "share", "--", "inria", "gsplat_default")
    missed = [(name, case) for name in MUTANTS for case in MUTANTS[name] if not complaints(case, found[name][case])]
    assert not missed
