"""A few hundred mutated files of every kind; `benchmarks.soak_files` runs as many as one has time for."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pytest

from skipgs_plug.trainer import InputError


@pytest.fixture
def soak_files(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(Path(__file__).parents[2])
    return importlib.import_module("benchmarks.soak_files")


def test_error_or_right_load(soak_files: ModuleType) -> None:
    outcomes = soak_files.run(count=400, seed=20)
    assert sum(outcomes.values()) == 400 and min(outcomes["refused"], outcomes["loaded"]) > 20


def test_cases_repeat(soak_files: ModuleType) -> None:
    data = bytes(range(256))
    first, second = (soak_files.Case(3, 14) for _ in range(2))
    assert first.what == second.what
    for mutate in first.mutations:
        assert mutate(data, first.random) == mutate(data, second.random)


def test_what_counts_as_a_failure(soak_files: ModuleType, tmp_path: Path) -> None:
    case = soak_files.Case(0, 0)
    (tmp_path / case.file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / case.file).write_bytes(b"sound")

    def outcome(load) -> str:
        return soak_files.Case(0, 0).run(soak_files.Source(tmp_path, [case.file], load))["outcome"]

    def fail(error: BaseException) -> None:
        raise error

    assert outcome(lambda: None) == "loaded"
    assert outcome(lambda: fail(InputError("One sentence."))) == "refused"
    for error in (ValueError("x"), MemoryError(), InputError(""), InputError("two\nlines"), InputError("x" * 3000)):
        assert outcome(lambda error=error: fail(error)) == "failed"
    assert outcome(lambda: (tmp_path / "left").touch()) == "failed"
    assert (tmp_path / case.file).read_bytes() == b"sound"


DIES_IN_CASE_5 = """
import os
print("{}")
print('{"case": 4, "outcome": "loaded"}', flush=True)
os.kill(os.getpid(), 11)
"""


def test_a_crash_is_reported_with_its_case(soak_files: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes, failures = soak_files.Counter(), []
    monkeypatch.setattr(soak_files, "child_command", lambda seed, first, end: DIES_IN_CASE_5)
    assert soak_files.run_batch(0, 4, 9, outcomes, failures) == 5
    assert outcomes == {"loaded": 1} and len(failures) == 1
    assert failures[0].startswith(f"case 5: {soak_files.Case(0, 5).what}: ended with -11")
