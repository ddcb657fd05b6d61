"""A script that ends by `os._exit`, or puts another program in its place: the gate writes its results before."""

import os
import sys

import pytest

from skipgs_plug.scripts.exits import before_process_ends


@pytest.fixture
def ended(monkeypatch):
    """Exit codes and programs with which the process would have ended."""
    codes = []
    monkeypatch.setattr(os, "_exit", codes.append)
    monkeypatch.setattr(os, "execv", lambda path, words: codes.append(words))
    monkeypatch.setattr(os, "execve", lambda path, words, environment: codes.append(words))
    return codes


def test_the_call_is_made_first(ended):
    own = os._exit
    with before_process_ends(lambda: ended.append("called"), ended.append):
        os._exit(3)
    assert ended == ["called", 3] and os._exit is own


def test_a_call_that_fails_does_not_keep_the_process(ended):
    with before_process_ends(lambda: [][0], ended.append), pytest.raises(IndexError):
        os._exit(3)
    assert ended == [3]


def test_the_call_is_told_of_the_program_that_was_found(ended, tmp_path):
    program = tmp_path / "bin" / "program"
    program.parent.mkdir()
    program.touch(mode=0o755)
    own = os.execv, os.execve
    with before_process_ends(lambda: None, ended.append):
        os.execv(program, ["one"])
        os.execlpe(str(program), "two", {})
    assert ended == [str(program), ["one"], str(program), ("two",)] and (os.execv, os.execve) == own
    with before_process_ends(lambda: None, ended.append):
        os.execv(tmp_path / "none", ["none"])
    assert ended[4:] == [["none"]]


def test_a_call_may_keep_the_process(ended):
    with before_process_ends(lambda: None, lambda program: [][0]), pytest.raises(IndexError):
        os.execv(os.path.realpath(sys.executable), ["python"])
    assert ended == []
