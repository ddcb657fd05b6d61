"""Processes that a script starts: those that no gate reaches are told of."""

import os
import subprocess
import sys

import pytest
import torch

from skipgs_plug.scripts.processes import Beginning, told_if_it_starts_itself, told_if_it_trains


def trained(times):
    for _ in range(times):
        torch.ones(1, requires_grad=True).sum().backward()


def test_training_without_a_gate_is_said_once(capfd):
    own = torch.Tensor.backward
    with told_if_it_trains("train.py"):
        trained(9)
        assert capfd.readouterr().err == ""
        trained(20)
    said = "skipgs-plug: trained() called backward in a process that train.py has spawned, which no gate reaches. "
    error = capfd.readouterr().err
    assert error.startswith(said) and error.count("\n") == 1 and torch.Tensor.backward is own


@pytest.mark.parametrize("matters", [True, False])
def test_a_script_that_starts_itself_is_said(tmp_path, capfd, monkeypatch, matters):
    script = tmp_path / "train.py"
    script.write_text("")
    monkeypatch.chdir(tmp_path)
    own = subprocess.Popen.__init__, os.system
    with told_if_it_starts_itself(script, lambda: matters):
        subprocess.run([sys.executable, "train.py", "-m", "out"], check=True)
        os.system(f"{sys.executable} '{script}'")
        subprocess.run(args=f"{sys.executable} train.py", shell=True, check=True)
    said = "skipgs-plug: train.py starts itself in another process, which no gate reaches. "
    assert capfd.readouterr().err.count(said) == 3 * matters
    assert (subprocess.Popen.__init__, os.system) == own


def test_other_programs_are_not_said(tmp_path, capfd):
    script = tmp_path / "train.py"
    script.write_text("")
    with told_if_it_starts_itself(script, lambda: True):
        subprocess.run([sys.executable, "-c", "pass", tmp_path / "other" / "train.py"], check=True)
        subprocess.run([b"true", b"train.py"], check=True, cwd=tmp_path)
        os.system("true 'an end that is missing")
    assert "skipgs-plug" not in capfd.readouterr().err


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")
def test_a_process_and_those_forked_from_it_know_where_training_began():
    before, after = Beginning(), Beginning()
    after.note()
    child = os.fork()
    if child == 0:
        before.note()
        os._exit(0 if before.here and not after.here and after.anywhere else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert before.anywhere and not before.here and after.here
