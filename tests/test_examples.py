"""Every example runs on the CPU: the loops as they are, the others on checkouts made of the look-alikes."""

import difflib
import importlib
import json
import runpy
import sys
from pathlib import Path

import cases
import pytest

from skipgs_plug.adapters.registry import find_script_adapter

EXAMPLES = Path(__file__).parents[1] / "examples"
LOOKALIKES = Path(__file__).parent / "adapters"


@pytest.fixture
def run_example(monkeypatch, tmp_path):
    """Run an example as a script, in an empty folder; give its exit code."""
    before = set(sys.modules)

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        monkeypatch.syspath_prepend(EXAMPLES)
        monkeypatch.syspath_prepend(LOOKALIKES)
        monkeypatch.chdir(tmp_path)
        try:
            runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        except SystemExit as stop:
            return stop.code
        return 0

    yield run
    for name in set(sys.modules) - before:
        if name.split(".")[0] in ("gaussian_renderer", "scene", "_checkout", "gaussian_splatting", "nerfstudio"):
            del sys.modules[name]


def make_checkout(folder, lookalike, script):
    """A checkout in the layout of the Inria family, whose parts are those of a look-alike."""
    from_lookalike = f"from lookalikes.{lookalike} import *\n"
    (folder / "gaussian_renderer").mkdir(parents=True)
    (folder / "scene").mkdir()
    (folder / "gaussian_renderer/__init__.py").write_text(from_lookalike)
    (folder / "scene/__init__.py").write_text("")
    (folder / "scene/gaussian_model.py").write_text(from_lookalike)
    source = (LOOKALIKES / "lookalikes" / f"{lookalike}.py").read_text()
    renderers = [word for word in ("render_fastgs", "render_imp", "render") if f"def {word}(" in source]
    of_model = [word for word in ("GaussianModel", "build_scaling_rotation") if f" {word}(" in source]
    (folder / script).parent.mkdir(exist_ok=True)
    above = "import os, sys\nsys.path.append(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))\n"
    (folder / script).write_text(
        f"{above if '/' in script else ''}{source}\nfrom gaussian_renderer import {', '.join(renderers)}\n"
        f"from scene.gaussian_model import {', '.join(of_model)}\n"
        "if __name__ == '__main__':\n    train()\n    print('Training complete.')\n"
    )


SCRIPTS = {case.module.__name__.rpartition(".")[2]: case.module for case in cases.SCRIPTS}


@pytest.mark.parametrize("lookalike", SCRIPTS)
def test_script_of_a_checkout_is_run_gated(lookalike, run_example, tmp_path, capfd):
    module = SCRIPTS[lookalike]
    example, script = f"train_{module.ADAPTER}.py", getattr(module, "SCRIPT", "train.py")
    make_checkout(tmp_path / "checkout", lookalike, script)
    (tmp_path / "output").mkdir()
    choice = ["--script", script] if "--script" in (EXAMPLES / example).read_text() else []
    code = run_example(
        example, "--repo", tmp_path / "checkout", *choice, "--warmup", "3", "--pause-iters", "4", "--", "-s"
    )
    assert code == 0
    assert capfd.readouterr().out.endswith("Training complete.\n")
    report = json.loads((tmp_path / "output" / "skipgs.json").read_text())
    assert report["settings"]["adapter"] == module.ADAPTER and report["settings"]["start_iter"] == module.START
    assert report["iterations"] == module.LAST + 1 - module.FIRST
    assert report["backwards_skipped"] > 0


def make_package(folder, **files):
    for path, source in files.items():
        file = folder / (path.replace("__", "/") + ".py")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(source)
        for parent in file.parents:
            if parent == folder:
                break
            (parent / "__init__.py").touch()


def test_gsplat_script_is_run_gated(run_example, tmp_path, monkeypatch):
    make_package(
        tmp_path / "checkout",
        gsplat__distributed=(
            "def _distributed_worker(world_rank, world_size, fn, args):\n    return fn(0, 0, 1, args)\n"
            "def cli(fn, args, verbose=False):\n    return _distributed_worker(0, 1, fn=fn, args=args)\n"
        ),
        examples__simple_trainer=(
            "from gsplat.distributed import cli\nfrom lookalikes import gsplat_runner\n"
            "class Runner(gsplat_runner.Runner):\n    pass\n"
            "def main(local_rank, world_rank, world_size, cfg):\n"
            "    Runner(gsplat_runner.MCMCStrategy(), world_size=world_size, result_dir='results').train()\n"
            "if __name__ == '__main__':\n    cli(main, None)\n"
        ),
    )
    for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path / "checkout")
    try:
        assert run_example("train_gsplat.py", "--repo", tmp_path / "checkout", "--warmup", "3", "--", "mcmc") == 0
    finally:
        for name in [name for name in sys.modules if name.split(".")[0] == "gsplat"]:
            del sys.modules[name]
    report = json.loads((tmp_path / "results" / "skipgs.json").read_text())
    assert report["iterations"] == 60 and report["backwards_skipped"] > 0


MODULES = {
    "train_gaussian_splatting.py": {
        "gaussian_splatting__prepare": "from lookalikes import step_trainer\n"
        "def prepare_trainer():\n    return step_trainer.make()\n",
        "gaussian_splatting__train": "from argparse import Namespace\n"
        "from gaussian_splatting.prepare import prepare_trainer\n"
        "from lookalikes import step_trainer\n"
        "if __name__ == '__main__':\n    args = Namespace(destination='results')\n"
        "    step_trainer.training(prepare_trainer(), step_trainer.dataset(), 60)\n",
    },
    "train_nerfstudio.py": {
        "nerfstudio__engine__trainer": "from pathlib import Path\nfrom lookalikes import nerfstudio\n"
        "class Trainer(nerfstudio.Trainer):\n    pass\n",
        "nerfstudio__scripts__train": "from pathlib import Path\nfrom nerfstudio.engine.trainer import Trainer\n"
        "if __name__ == '__main__':\n    trainer = Trainer()\n    trainer.base_dir = Path('results')\n"
        "    trainer.setup().train()\n",
    },
}


@pytest.mark.parametrize("example", MODULES)
def test_installed_command_is_run_gated(example, run_example, tmp_path, monkeypatch):
    make_package(tmp_path / "site", **MODULES[example])
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert run_example(example, "--warmup", "3", "--pause-iters", "4", "--", "-s", "data") == 0
    report = json.loads((tmp_path / "results" / "skipgs.json").read_text())
    assert report["iterations"] == 60 and report["backwards_skipped"] > 0


# Script, the module from which it imports its trainer, and the names in that module.
OBJECTS = {
    "litegs": ("example_train.py", "litegs/training/trainer.py", "start"),
    "faster_gs": ("scripts/train.py", "Methods/FasterGS/Trainer.py", "FasterGSTrainer"),
    "edgs": ("train.py", "source/trainer.py", "EDGSTrainer"),
    "threedgrut": ("train.py", "threedgrut/trainer.py", "Trainer3DGRUT"),
    "fvdb": ("train.py", "fvdb_reality_capture/training/scene_optimization_runner.py", "SceneOptimizationRunner"),
}
TRAINS = {
    "litegs": "litegs.training.trainer.train()",
    "faster_gs": "DiscoverSourcePath = Framework = None\n    FasterGSTrainer().run(None)",
    "edgs": "EDGSTrainer().train()",
    "threedgrut": "Trainer3DGRUT().run_training()",
    "fvdb": "SceneOptimizationRunner().train()",
}


@pytest.mark.parametrize("lookalike", OBJECTS)
def test_script_around_a_trainer_object_is_run_gated(lookalike, run_example, tmp_path, monkeypatch):
    script, module, name = OBJECTS[lookalike]
    source = (LOOKALIKES / "lookalikes" / f"{lookalike}.py").read_text()
    package = tmp_path / "checkout" / module
    package.parent.mkdir(parents=True)
    package.write_text(source)
    dotted = module.removesuffix(".py").replace("/", ".")
    file = tmp_path / "checkout" / script
    file.parent.mkdir(exist_ok=True)
    above = "import os, sys\nsys.path.append(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))\n"
    file.write_text(
        f"{above if '/' in script else ''}import {dotted}\nfrom {dotted} import {name}\n"
        f"if __name__ == '__main__':\n    {TRAINS[lookalike]}\n"
    )
    (tmp_path / "results").mkdir()
    adapter = importlib.import_module(f"lookalikes.{lookalike}").ADAPTER
    top = dotted.partition(".")[0]
    try:
        assert find_script_adapter(file).name == adapter
        options = ["--warmup", "3", "--pause-iters", "4"]
        assert run_example(f"train_{adapter}.py", "--repo", tmp_path / "checkout", *options, "--", "-s") == 0
    finally:
        for loaded in [one for one in sys.modules if one.partition(".")[0] == top]:
            del sys.modules[loaded]
    report = json.loads((tmp_path / "results" / "skipgs.json").read_text())
    assert report["settings"]["adapter"] == adapter and report["backwards_skipped"] > 0


def test_every_example_is_tested():
    objects = [importlib.import_module(f"lookalikes.{name}") for name in OBJECTS]
    tested = {f"train_{module.ADAPTER}.py" for module in [*SCRIPTS.values(), *objects]}
    tested |= {*MODULES, "train_gsplat.py"}
    assert {path.name for path in EXAMPLES.glob("train_*.py")} == tested


@pytest.mark.parametrize("name", ["manual_loop.py", "manual_loop_skipgs.py"])
def test_manual_loops_run_twenty_steps(name, run_example, capfd):
    assert run_example(name, "--steps", "20") == 0
    output = capfd.readouterr().out
    assert "20 steps, PSNR" in output
    assert ("SkipGS: " in output and "of 10 backwards skipped" in output) == (name == "manual_loop_skipgs.py")


def test_manual_loops_differ_by_the_gate_only():
    plain, gated = (
        (EXAMPLES / name).read_text().splitlines()[1:] for name in ("manual_loop.py", "manual_loop_skipgs.py")
    )
    changed = [line for line in difflib.ndiff(plain, gated) if line[0] in "+-"]
    assert [line for line in changed if line[0] == "-"] == [
        "-     loss.backward()",
        "-     optimizer.step()",
        "-     optimizer.zero_grad(set_to_none=True)",
    ]
    assert [line[2:] for line in changed if line[0] == "+"] == [
        "from skipgs_plug import SkipGate",
        "gate = SkipGate(start_iter=args.steps // 2, warmup=args.steps // 20)",
        "    if gate.backward(loss, view=name, step=step):",
        "        optimizer.step()",
        "        optimizer.zero_grad(set_to_none=True)",
        "print(gate.summary())",
    ]
