"""Options that are off keep what they would assign; settings of the process are options too."""

import os
import random
import sys
from types import SimpleNamespace

import pytest
import torch
from read_milestones import found

from skipgs_plug import SkipGSError


def test_what_an_option_that_is_off_would_assign_keeps_its_value():
    def loop(stop, opt):
        every, other, last = 30, 40, 0.5
        for step in stop(opt=opt, every=every, other=other, last=last):
            if opt.turbo:
                every = int(last)
            if not opt.turbo:
                pass
            else:
                other = int(last)
            if step % every == 0:
                print("save")
            if step % other == 0:
                print("test")

    assert found(lambda stop: loop(stop, SimpleNamespace(turbo=False))) == {
        "step % every == 0": [60, 90],
        "step % other == 0": [80],
    }
    with pytest.raises(SkipGSError, match=r"cannot be evaluated ahead \(step % every == 0"):
        found(lambda stop: loop(stop, SimpleNamespace(turbo=True)))


def in_environment(stop):
    for step in stop():
        loss = 0.1 + random.random()
        if os.environ.get("SKIPGS_DEBUG") and step % loss == 0:
            print("save")


def in_environment_by_function(stop):
    for step in stop():
        loss = 0.1 + random.random()
        if os.getenv("SKIPGS_DEBUG", "") and step % loss == 0:
            print("save")


def in_arguments(stop):
    for step in stop():
        loss = 0.1 + random.random()
        if "--skipgs-debug" in sys.argv and step % loss == 0:
            print("save")


def without_cuda(stop):
    for step in stop():
        loss = 0.1 + random.random()
        if not torch.cuda.is_available() and step % loss == 0:
            print("save")


@pytest.mark.parametrize("loop", [in_environment, in_environment_by_function, in_arguments, without_cuda])
def test_settings_of_the_process_are_options(loop, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert found(loop) == {}


def test_settings_that_the_loop_changes_are_none():
    def loop(stop):
        for step in stop():
            loss = 0.1 + random.random()
            if os.environ.get("SKIPGS_DEBUG") and step % loss == 0:
                print("save")
            os.environ["SKIPGS_DEBUG"] = "on"

    with pytest.raises(SkipGSError, match="cannot be evaluated ahead"):
        found(loop)
