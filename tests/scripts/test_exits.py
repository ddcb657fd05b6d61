"""A script that ends by `os._exit`: the gate writes its results before, in that process alone."""

import os

import pytest

from skipgs_plug.scripts.exits import before_os_exit


@pytest.fixture
def ended(monkeypatch):
    """Exit codes with which the process would have ended."""
    codes = []
    monkeypatch.setattr(os, "_exit", codes.append)
    return codes


def test_the_call_is_made_first(ended):
    own = os._exit
    with before_os_exit(lambda: ended.append("called")):
        os._exit(3)
    assert ended == ["called", 3] and os._exit is own


def test_a_call_that_fails_does_not_keep_the_process(ended):
    with before_os_exit(lambda: [][0]), pytest.raises(IndexError):
        os._exit(3)
    assert ended == [3]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")
def test_a_forked_child_does_not_make_the_call(tmp_path):
    with before_os_exit((tmp_path / "called").touch):
        child = os.fork()
        if child == 0:
            os._exit(5)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 5
    assert not (tmp_path / "called").exists()
