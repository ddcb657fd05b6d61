"""A gate for a script imports none of the trainer's modules: the script may extend its path first."""

import runpy
import sys
import textwrap

import pytest
from cases import RULE
from lookalikes import step_trainer
from lookalikes.splats import new_log

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.adapters.base import AbstractAdapter

# By adapter: the trainer's module, its content, and the lines of a script that imports it.
SCRIPTS = {
    "nerfstudio": (
        "nerfstudio.engine.trainer",
        """
        from lookalikes import nerfstudio
        class Trainer(nerfstudio.Trainer):
            pass
        """,
        """
        from nerfstudio.engine.trainer import Trainer
        Trainer().setup().train()
        """,
    ),
    "step_trainer": (
        "gaussian_splatting.prepare",
        """
        from lookalikes import step_trainer
        def prepare_trainer():
            return step_trainer.make()
        """,
        """
        from gaussian_splatting.prepare import prepare_trainer
        from lookalikes import step_trainer
        def training(trainer, dataset):
            for step in range(1, step_trainer.LAST + 1):
                trainer.step(step_trainer.pick_camera(dataset, step))
        training(prepare_trainer(), step_trainer.dataset())
        """,
    ),
    "gsplat": (
        "gsplat.distributed",
        """
        def _distributed_worker(rank, size, fn, args):
            fn(args)
        def cli(fn, args):
            _distributed_worker(0, 1, fn, args)
        """,
        """
        from gsplat.distributed import cli
        from lookalikes import gsplat_runner
        class Runner(gsplat_runner.Runner):
            def train(self):
                super().train()
        cli(lambda strategy: Runner(strategy()).train(), gsplat_runner.DefaultStrategy)
        """,
    ),
}


@pytest.fixture(params=SCRIPTS)
def script(request, tmp_path, monkeypatch):
    """Name of an adapter, and a function that extends the path and runs a script in which its trainer trains."""
    module, content, lines = SCRIPTS[request.param]
    file = tmp_path.joinpath(*module.split(".")).with_suffix(".py")
    file.parent.mkdir(parents=True)
    file.write_text(textwrap.dedent(content))
    for folder in file.parents[: module.count(".")]:
        (folder / "__init__.py").touch()
    top = module.partition(".")[0]
    for name in [name for name in sys.modules if name == top or name.startswith(f"{top}.")]:
        monkeypatch.delitem(sys.modules, name)

    path = tmp_path / "train.py"
    path.write_text(textwrap.dedent(lines))

    def run(gate):
        monkeypatch.syspath_prepend(tmp_path)
        runpy.run_path(str(path), init_globals=gate.script_globals)

    new_log()
    yield request.param, run
    for name in [name for name in sys.modules if name == top or name.startswith(f"{top}.")]:
        del sys.modules[name]


def test_a_script_extends_its_path_before_it_imports_its_trainer(script):
    name, run = script
    with SkipGate(adapter=name, **RULE) as gate:
        run(gate)
    gate.verify()
    assert gate.report()["backwards_skipped"] > 0 and gate.patched == []


NOT_TOLD = [
    ({"refine_share": "auto"}, 'refine_share="auto" must know the training views.*; give a share, such as 0.2'),
    ({"grow_share": 0.5}, "grow_share leaves out iterations of densification.*; remove grow_share"),
    ({"compensate": True}, "compensate=True must know the last iteration.*; use the gate without it"),
]


@pytest.fixture
def unknown_events(monkeypatch):
    """Give the trainer a bound that the adapter does not know, so that not all of its events are known."""
    monkeypatch.setattr(step_trainer.OpacityResetter, "relocate_until_iter", 18, raising=False)


@pytest.mark.parametrize("script", ["step_trainer"], indirect=True)
@pytest.mark.parametrize(("settings", "sentence"), NOT_TOLD)
@pytest.mark.filterwarnings("ignore:The trainer does more than")
def test_a_refused_script_gets_no_advice_to_call_a_gate(script, settings, sentence, unknown_events):
    name, run = script
    with pytest.raises(SkipGSError, match=sentence) as error, SkipGate(adapter=name, **settings) as gate:
        run(gate)
    assert "gate." not in str(error.value)


@pytest.mark.parametrize("script", ["step_trainer"], indirect=True)
def test_a_script_that_is_warned_gets_no_advice_to_call_a_gate(script, recwarn, unknown_events):
    name, run = script
    with SkipGate(adapter=name, share=0.5) as gate:
        run(gate)
    assert gate.released is None
    assert [str(one.message).partition("known, so ")[2] for one in recwarn if "events" in str(one.message)] == [
        "all of these iterations run, and only later ones are left out."
    ]


def test_an_error_after_the_import_releases_the_gate_and_the_script_trains(script, monkeypatch, recwarn):
    def fails(*args):
        raise AttributeError("of the adapter")

    name, run = script
    monkeypatch.setattr(AbstractAdapter, "attach_on_call", fails)
    monkeypatch.setattr("skipgs_plug.core.hooks.Hooks.always", fails)
    with SkipGate(adapter=name, **RULE) as gate:
        run(gate)
    assert [str(one.message) for one in recwarn] == [gate.released] and "of the adapter" in gate.released
