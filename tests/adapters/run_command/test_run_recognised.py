"""`skipgs-plug run`: which scripts are recognised, which are refused before they run, and `--no-gate`."""

import json
import py_compile
import sys
from pathlib import Path

import pytest
from inria_checkout import forget

from skipgs_plug import cli
from skipgs_plug.adapters.speedy_splat import SpeedySplat


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nerfacto", "--", "train.py"], "no adapter 'nerfacto'"),
        (
            ["reference", "--cpu", "--", "train.py"],
            "no stand-in for the rasterizer of 'reference'",
        ),
        (["inria"], "no script to run"),
        (["inria", "--", "absent.py"], "absent.py: name the training script after '--'"),
        (["inria", "--resume-gate", "SCRIPT", "--", "SCRIPT"], "does not hold a gate state: give a file that ends in"),
        (["inria", "--ema-decay", "2", "--", "SCRIPT"], "ema_decay must be in [0, 1)"),
    ],
)
def test_bad_input_is_one_sentence(arguments, sentence, tmp_path, capfd):
    script = tmp_path / "train.py"
    script.write_text("")
    given = [str(script) if argument == "SCRIPT" else argument for argument in arguments]
    assert cli.main(["run", *given]) == cli.BAD_INPUT
    error = capfd.readouterr().err
    assert sentence in error and error.count("\n") == 1


def test_no_gate_runs_a_compiled_script(tmp_path, capfd):
    source, script = tmp_path / "train.py", tmp_path / "train.pyc"
    source.write_text("print('trained')")
    py_compile.compile(str(source), str(script))
    assert cli.main(["run", "auto", "--no-gate", "--", str(script)]) == 0
    assert capfd.readouterr().out == "trained\n"
    assert cli.main(["run", "auto", "--", str(script)]) == cli.BAD_INPUT


def test_no_gate_runs_a_script_that_no_adapter_knows(tmp_path, capfd):
    script = tmp_path / "train.py"
    script.write_text("import pathlib, sys\npathlib.Path(sys.argv[1]).write_text('trained')\nsys.exit(3)\n")
    assert cli.main(["run", "auto", "--no-gate", "--", str(script), str(tmp_path / "model")]) == 3
    assert (tmp_path / "model").read_text() == "trained"
    assert "train.py runs without a gate, and so without skipgs.json: No adapter knows" in capfd.readouterr().err
    assert cli.main(["run", "auto", "--no-gate", "--cpu", "--", str(script), "x"]) == cli.BAD_INPUT
    assert "an adapter knows, and none knows train.py: run it without --cpu" in capfd.readouterr().err


def test_a_script_beside_the_training_script_runs_on_the_cpu_without_a_gate(checkout, capfd):
    render = Path(checkout).with_name("render.py")
    render.write_text(
        "import torch\n"
        "from gaussian_renderer import GaussianRasterizer\n"
        "print(GaussianRasterizer.__module__, torch.zeros(2).cuda().device)\n"
    )
    assert cli.main(["run", "auto", "--cpu", "--", str(render)]) == cli.BAD_INPUT
    assert "render.py, which has no function at all: run it with --no-gate" in capfd.readouterr().err
    assert cli.main(["run", "auto", "--cpu", "--no-gate", "--", str(render)]) == 0
    out, error = capfd.readouterr()
    assert out.startswith("skipgs_plug.compat.") and out.endswith(" cpu\n")
    assert "render.py is run as inria." in error
    # Without a train.py, all training scripts of the folder must have one adapter.
    Path(checkout).rename(render.with_name("train_one.py"))
    assert cli.main(["run", "auto", "--cpu", "--no-gate", "--", str(render)]) == 0
    mark = "def training(opt):\n    GaussianModel(build_scaling_rotation)\n    loss.backward()\n"
    render.with_name("train_two.py").write_text(mark)
    assert cli.main(["run", "auto", "--cpu", "--no-gate", "--", str(render)]) == cli.BAD_INPUT


def test_auto_recognises_the_script_before_it_runs(checkout, tmp_path, capfd):
    assert cli.main(["run", "auto", "--cpu", "--warmup", "10", "--", checkout, str(tmp_path)]) == 0
    assert "skipgs-plug: train.py is run as inria." in capfd.readouterr().err
    assert json.loads((tmp_path / "skipgs.json").read_text())["settings"]["adapter"] == "inria"
    other = tmp_path / "other.py"
    other.write_text("def main():\n    pass\n")
    assert cli.main(["run", "auto", "--", str(other)]) == cli.BAD_INPUT
    error = capfd.readouterr().err
    assert "other.py, which has no function training(), but main: run it with --no-gate if it does not train" in error
    assert "name the script that holds the training loop" in error
    assert "name one of" not in error and error.count("\n") == 1
    other.write_text("def training():\n    model = OwnModel()\n    model.loss().backward()\n")
    assert cli.main(["run", "auto", "--", str(other)]) == cli.BAD_INPUT
    assert "a function training(), but no GaussianModel: gate its loop by hand" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("def load():\n    pass\nclass Runner:\n    def step(self):\n        self.loss.backward()\n", "in Runner"),
        ("def load():\n    pass\ndef loss():\n    pass\nwhile True:\n    loss().backward()\n", "itself"),
    ],
    ids=["in a class", "in no function"],
)
def test_a_loop_of_ones_own_is_named(source, found, tmp_path, capfd):
    script = tmp_path / "own.py"
    script.write_text(source)
    assert cli.main(["run", "auto", "--", str(script)]) == cli.BAD_INPUT
    assert f"no function training(), but calls backward {found}: gate that loop by hand" in capfd.readouterr().err


def test_only_calls_of_backward_and_named_functions_are_named(tmp_path, capfd):
    script = tmp_path / "own.py"
    script.write_text("class Render:\n    def backward(context, gradient):\n        return gradient\nf = lambda: 10\n")
    assert cli.main(["run", "auto", "--", str(script)]) == cli.BAD_INPUT
    assert "no function training(), but Render: run it" in capfd.readouterr().err


def test_wrong_adapter_is_refused_before_anything_is_imported(checkout, tmp_path, capfd):
    assert cli.main(["run", "mcmc", "--cpu", "--", checkout, str(tmp_path)]) == cli.BAD_INPUT
    assert "looks like the training script of 'inria'" in capfd.readouterr().err
    assert "gaussian_renderer" not in sys.modules


def test_loop_outside_of_training_is_refused_before_anything_is_imported(checkout, tmp_path, capfd):
    source = Path(checkout).read_text().replace("def training(opt, out)", "def scene_reconstruction(opt, out)")
    stages = (
        "def training(opt, out):\n    for stage in range(2):\n        scene_reconstruction(opt, out)\n\nif __name__"
    )
    Path(checkout).write_text(source.replace("if __name__", stages))
    assert cli.main(["run", "auto", "--cpu", "--", checkout, str(tmp_path)]) == cli.BAD_INPUT
    error = capfd.readouterr().err
    assert "loss.backward(), scene_reconstruction() calls backward in its place, and such a loop is not" in error
    assert "gaussian_renderer" not in sys.modules


def test_helper_that_the_script_imports_is_read(checkout, tmp_path):
    """It sets the model up anew in iteration 29, which the script's own source does not show."""
    script = Path(checkout)
    late = "def maybe_reset(model, step):\n    if step == 29:\n        model.training_setup()\n"
    (script.parent / "fork_of_utils.py").write_text(late)
    source = script.read_text().replace("loss.backward()", "loss.backward(); maybe_reset(gaussians, iteration)")
    script.write_text(f"from fork_of_utils import maybe_reset\n{source}")
    with pytest.warns(RuntimeWarning, match=r"30 instead of 20: the loop calls training_setup\(\) until iteration 29"):
        assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 0
    assert json.loads((tmp_path / "skipgs.json").read_text())["settings"]["start_iter"] == 30


def test_script_outside_its_checkout_is_said(checkout, tmp_path, capfd):
    lonely = tmp_path / "lonely" / "train.py"
    lonely.parent.mkdir()
    lonely.write_text(Path(checkout).read_text())
    assert cli.main(["run", "inria", "--cpu", "--", str(lonely), str(tmp_path)]) == 1
    assert "train.py is not in its checkout: its folder has no gaussian_renderer" in capfd.readouterr().err


def test_script_in_a_subfolder_may_extend_its_path_first(checkout, tmp_path, capfd):
    script = Path(checkout)
    inner = script.parent / "ms" / "train.py"
    inner.parent.mkdir()
    lines = "import os, sys\nsys.path.append(os.path.join(os.path.dirname(os.path.abspath(__file__)), '..'))\n"
    inner.write_text(lines + script.read_text())
    script.unlink()
    assert cli.main(["run", "auto", "--cpu", "--warmup", "10", "--", str(inner), str(tmp_path)]) == 0
    assert json.loads((tmp_path / "skipgs.json").read_text())["backwards_skipped"] > 0
    assert not any("_Finder" in repr(finder) for finder in sys.meta_path)


@pytest.mark.parametrize("gate", [[], ["--share", "0.5"], ["--no-gate"]])
def test_modules_of_other_names_are_refused_before_an_iteration_has_trained(
    gate, checkout, tmp_path, capfd, monkeypatch
):
    script = Path(checkout)
    for name in ("own_gaussian_renderer", "own_scene", "own_scene.gaussian_model"):  # those of other cases
        monkeypatch.delitem(sys.modules, name, raising=False)
    for name in ("gaussian_renderer", "scene"):
        (script.parent / name).rename(script.parent / f"own_{name}")
    script.write_text(
        script.read_text().replace("from gaussian_", "from own_gaussian_").replace("from sc", "from own_sc")
    )
    code = cli.main(["run", "auto", "--cpu", *gate, "--", checkout, str(tmp_path)])
    assert code == (0 if gate == ["--no-gate"] else cli.BAD_INPUT) and (tmp_path / "model.pth").exists() == (code == 0)
    why = "it trains without a module gaussian_renderer or module scene.gaussian_model"
    assert (why in capfd.readouterr().err) == (code != 0)


@pytest.mark.parametrize("gate", [[], ["--share", "0.5"], ["--no-gate"]])
def test_a_model_of_another_class_is_refused_before_an_iteration_has_trained(gate, checkout, tmp_path, capfd):
    """As in GES, which imports GaussianModel and trains its LaplacianModel."""
    model = Path(checkout).parent / "scene" / "gaussian_model.py"
    model.write_text(f"{model.read_text()}\nOwn = GaussianModel\nclass GaussianModel(Own):\n    pass\n")
    script = Path(checkout)
    text = script.read_text().replace("import GaussianModel", "import GaussianModel, Own")
    script.write_text(text.replace("= GaussianModel()", "= Own()"))
    code = cli.main(["run", "auto", "--cpu", *gate, "--", checkout, str(tmp_path)])
    assert code == (0 if gate == ["--no-gate"] else cli.BAD_INPUT) and (tmp_path / "model.pth").exists() == (code == 0)
    assert ("it trains without a GaussianModel" in capfd.readouterr().err) == (code != 0)


def test_no_gate_is_never_refused(checkout, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(SpeedySplat, "stand_ins", "inria")  # the look-alike has Inria's rasterizer
    options = ["--always", "5", "--share", "7", "--resume-gate", "absent"]  # a run without a gate does not read them
    wrong = ["run", "speedy_splat", "--no-gate", *options, "--cpu", "--", checkout, str(tmp_path)]
    assert cli.main(wrong) == 0 and (tmp_path / "model.pth").exists()
    assert "train.py runs without a gate, and so without skipgs.json: Adapter 'speedy_s" in capfd.readouterr().err
    forget()
    script = Path(checkout)
    script.write_text(script.read_text().replace("loss.backward()", "loss.mul_(1); loss.backward()"))
    with pytest.warns(RuntimeWarning, match=r"Training goes on, but its counts.* itself changes values \(mul_\)"):
        assert cli.main(["run", "auto", "--no-gate", "--cpu", "--", checkout, str(tmp_path)]) == 0
    forget()
    assert cli.main(["run", "auto", "--cpu", "--", checkout, str(tmp_path)]) == cli.BAD_INPUT
