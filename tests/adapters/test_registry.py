"""Adapters of users beside the built-in ones."""

from __future__ import annotations

import importlib
import re

import pytest

from skipgs_plug import SkipGate, SkipGSError, UnknownTrainerError, register_adapter
from skipgs_plug.adapters import AbstractAdapter, TrainerInfo, registry


class Mine:
    """A trainer that no built-in adapter knows."""

    def __init__(self) -> None:
        self.attached = False


class MyAdapter(AbstractAdapter):
    name = "mine"
    checked = "my trainer of today"

    @classmethod
    def matches(cls, trainer) -> bool:
        return isinstance(trainer, Mine)

    def attach(self, hooks) -> None:
        self.trainer.attached = True
        hooks.ready(TrainerInfo(5))


@pytest.fixture(autouse=True)
def own_registry(monkeypatch) -> None:
    monkeypatch.setattr(registry, "_registered", {})


def test_a_registered_adapter_is_found() -> None:
    with pytest.raises(UnknownTrainerError, match="Mine"):
        SkipGate(Mine())
    assert register_adapter(MyAdapter) is MyAdapter
    assert register_adapter(MyAdapter) is MyAdapter
    trainer = Mine()
    gate = SkipGate(trainer)
    assert trainer.attached
    assert gate.config.start_iter == 5
    assert gate.report()["settings"]["adapter"] == "mine"
    assert SkipGate(Mine(), adapter="mine").adapter is not gate.adapter


def test_names_are_taken_once() -> None:
    class Impostor(MyAdapter):
        name = "inria"

    class Nameless(MyAdapter):
        name = ""

    class Second(MyAdapter): ...

    register_adapter(MyAdapter)
    with pytest.raises(SkipGSError, match="'inria' already"):
        register_adapter(Impostor)
    with pytest.raises(SkipGSError, match="'mine' already"):
        register_adapter(Second)
    with pytest.raises(SkipGSError, match="name and checked"):
        register_adapter(Nameless)


def test_an_object_has_no_script_form() -> None:
    register_adapter(MyAdapter)
    with pytest.raises(SkipGSError, match="no script"):
        SkipGate(adapter="mine")


@pytest.mark.parametrize("name", registry.BUILTIN)
def test_every_built_in_adapter_loads_under_its_name(name: str) -> None:
    module, _, attribute = registry.BUILTIN[name].partition(":")
    adapter = getattr(importlib.import_module(module), attribute)
    assert adapter.name == name
    assert re.fullmatch(
        r".*\w \([^()]*\w\)", adapter.checked
    )  # names the checked commit, and in brackets how it was checked
    assert not adapter.matches(object())
