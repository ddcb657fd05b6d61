"""The doctor tries each backend in a process of its own, which may crash, and prints one sentence about it."""

from __future__ import annotations

import pytest

from skipgs_plug.commands import backend_probe, doctor


def test_a_backend_that_works_says_where() -> None:
    assert backend_probe.try_backend("warp") == (True, "renders and differentiates on cpu")


def test_a_backend_that_cannot_run_says_why() -> None:
    works, finding = backend_probe.try_backend("tarp")
    assert not works and finding.startswith("Backend 'tarp' is unknown")


@pytest.mark.parametrize(
    ("code", "finding"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGABRT)", "was ended by SIGABRT"),
        (
            "import sys; sys.stderr.write('LLVM ERROR: no assembler\\n'); sys.exit(3)",
            "ended with exit code 3: LLVM ERROR",
        ),
        ("import os; os._exit(0)", "ended with exit code 0"),  # it ends before it reports a result
    ],
)
def test_a_crash_is_a_sentence(
    code: str, finding: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(backend_probe, "CODE", code)
    assert not doctor.check_backend("warp")
    assert f"the process that tried it {finding}" in capsys.readouterr().out


def test_a_backend_that_hangs_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend_probe, "CODE", "import time; time.sleep(60)")
    monkeypatch.setattr(backend_probe, "LONGEST", 1)
    works, finding = backend_probe.try_backend("warp")
    assert not works and finding.startswith("no answer within")


def test_ends_of_processes_on_other_systems() -> None:
    assert backend_probe.how_it_ended(0xC0000005) == "ended with exit code 0xc0000005"
    assert backend_probe.how_it_ended(-200) == "was ended by signal 200"
