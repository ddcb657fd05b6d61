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


def test_a_script_that_starts_training_scripts_is_told_to_name_them(tmp_path, monkeypatch) -> None:
    loop = "def training(opt):\n    GaussianModel()\n    for iteration in range(9):\n        loss.backward()\n"
    (tmp_path / "train.py").write_text(loop)
    (tmp_path / "render.py").write_text("def render_sets(): ...\n")
    (tmp_path / "broken.py").write_text("def training(:\n")
    driver = tmp_path / "scripts/full_eval.py"
    driver.parent.mkdir()
    commands = ["python train.py -s {scene}", "python render.py -m out", "python broken.py", "python absent.py"]
    driver.write_text(f"import os\nfor scene in 'ab':\n    [os.system(one) for one in {commands}]\n")
    monkeypatch.chdir(tmp_path)  # such commands begin in the folder of the checkout
    with pytest.raises(UnknownTrainerError, match=r"full_eval.py holds no training loop, but names train.py, which"):
        registry.find_script_adapter(driver)
    own = tmp_path / "full_eval.py"  # files may also be beside the script
    own.write_text("name = 'train.py'\nos.system(f'python {name} -s x')\nprint('full_eval.py: done')\n")
    monkeypatch.chdir("/")
    with pytest.raises(UnknownTrainerError, match=r"write skipgs-plug run ADAPTER -- in place of python in a copy of"):
        registry.find_script_adapter(own)
    with pytest.raises(UnknownTrainerError, match=r"which has no function training\(\), but render_sets: run it"):
        registry.find_script_adapter(tmp_path / "render.py")


def test_a_script_that_only_mentions_training_is_not_told_to_start_it(tmp_path) -> None:
    (tmp_path / "train.py").write_text("def training(opt):\n    GaussianModel()\n    loss.backward()\n")
    script = tmp_path / "evaluate.py"
    script.write_text('"""Run python train.py before."""\ndef metrics():\n    "As train.py saved it."\n')
    with pytest.raises(UnknownTrainerError, match=r"no function training\(\), but metrics: run it with --no-gate"):
        registry.find_script_adapter(script)


@pytest.mark.parametrize("text", [f"{'x' * 300}.py", "x" * 10**6, "a\0b.py"], ids=["long name", "long text", "null"])
def test_any_text_in_a_script_is_no_reason_to_fail(text, tmp_path) -> None:
    script = tmp_path / "drive.py"
    script.write_text(f"BLOB = {text!r}\n")
    with pytest.raises(UnknownTrainerError, match="which has no function at all"):
        registry.find_script_adapter(script)


def test_a_script_that_may_not_be_read_is_not_one_that_is_started(tmp_path, monkeypatch) -> None:
    def closed(path, *args, **kwargs):
        raise PermissionError(13, "Permission denied", str(path))

    script = tmp_path / "drive.py"
    script.write_text("TRAINS = '/closed/train.py'\n")
    monkeypatch.setattr("os.stat", closed)  # as for a folder of another user
    assert registry._training_scripts_named_in(script) == []


def test_a_training_function_without_a_loop_is_not_said_to_be_missing(tmp_path) -> None:
    script = tmp_path / "train.py"
    script.write_text("def training(opt): pass\n")
    with pytest.raises(UnknownTrainerError, match=r"which has a function training\(\) without a training loop: run it"):
        registry.find_script_adapter(script)
