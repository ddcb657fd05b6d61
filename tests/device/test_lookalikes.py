"""Look-alikes of all adapters on a simulated second device: nothing mixes devices, and host reads are few.

Five look-alikes a day take their turn; all of them with `pytest tests/device --all-lookalikes`.
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


pytestmark = pytest.mark.skipif(
    not has_backend(), reason=f"torch {torch.__version__} has no backends in Python; 2.9 and later have"
)


def on_sim(*args: str) -> dict[str, Any]:
    """Host reads by mutant ("" for none), look-alike and settings; in a process of its own."""
    done = subprocess.run(
        [sys.executable, str(HERE / "lookalikes_on_sim.py"), *args], capture_output=True, text=True, timeout=290
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def reads(request) -> dict[str, dict[str, Any]]:
    turn = "all" if request.config.getoption("--all-lookalikes") else str(datetime.date.today().toordinal())
    return on_sim("--turn", turn)[""]  # type: ignore[no-any-return]


# Refusals of trainers whose loops do not count with a range, or not in the trainer itself.
NO_SHARE = ("No loop over range", "cannot leave out whole iterations")


def complaints(found: dict[str, Any]) -> list[str]:
    """What one look-alike's iterations, by settings, do that they should not."""
    wrong = []
    for settings, rows in found.items():
        if isinstance(rows, str):
            if not (settings == "share" and any(refusal in rows for refusal in NO_SHARE)):
                wrong.append(f"{settings}: {rows}")
            continue
        looks = 0
        for row in rows:
            own = [read for read in row["gate"] if not read[0].startswith("waited for a copy")]
            look = sum(count for _, file, _, count in own if file == "adapters/drift_check.py")
            views = sum(count for _, file, _, count in own if file == "core/distributed.py")
            rest = sum(count for *_, count in own) - look - views
            waits = sum(count for kind, *_, count in row["gate"] if kind.startswith("waited for a copy"))
            looks += look
            allowed = 0 if settings == "off" or row["reason"] == "inactive" else 1
            # A copy that was begun before the render costs no wait of its own.
            few = (
                rest <= allowed
                and waits <= allowed
                and look <= 1
                and (views <= 1 if settings == "share" else not views)
            )
            if not few:
                wrong.append(f"{settings}, iteration {row['step']} ({row['reason']}): {row['gate']}")
        if looks > LOOKS:
            wrong.append(f"{settings}: the drift check looked {looks} times")
    return wrong


def test_every_lookalike_has_its_turn():
    """Whatever the day, the turns that follow it reach all of them."""
    names = [f"lookalike {i}" for i in range(28)]
    assert {name for day in range(100, 106) for name in chosen(names, str(day))} == set(names)
    assert chosen(names, "all") == names and len(chosen(names, "100")) == 5


def test_no_device_is_mixed_and_reads_are_few(reads):
    assert not {name: wrong for name, found in reads.items() if (wrong := complaints(found))}


def test_the_gate_decides_there(reads):
    """Else the test above would see nothing."""
    for name, found in reads.items():
        assert any(row["skip"] for row in found["rule"]), name
        assert isinstance(found["share"], str) or any(row["reason"] == "full" for row in found["share"]), name


def test_defects_that_only_a_second_device_shows_are_caught():
    args = [part for name in MUTANTS for part in ("--mutant", name)]
    found = on_sim(*args, "--settings", "rule", "share", "--", "inria", "gsplat_default")
    missed = [(name, case) for name in MUTANTS for case in MUTANTS[name] if not complaints(found[name][case])]
    assert not missed
