"""`skipgs-plug run` on a look-alike of Inria's checkout that asks for CUDA and its extension modules."""

import errno
import io
import json
import os
import py_compile
import subprocess
import sys
import textwrap
from pathlib import Path
from pkgutil import resolve_name

import pytest
import torch

from skipgs_plug import SkipGSError, cli
from skipgs_plug.adapters.speedy_splat import SpeedySplat
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.policy import SkipPolicy
from skipgs_plug.scripts.checkpoints import Checkpoints

RENDERER = """
    import torch
    from diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer

    def render(camera, model):
        points = torch.zeros_like(model.xyz, requires_grad=True, device="cuda")
        settings = GaussianRasterizationSettings(
            image_height=16, image_width=16, tanfovx=0.5, tanfovy=0.5, bg=torch.zeros(3, device="cuda"),
            scale_modifier=1.0, viewmatrix=torch.eye(4).cuda(), projmatrix=camera.projection,
            sh_degree=0, campos=torch.zeros(3), prefiltered=False, debug=False)
        image, radii = GaussianRasterizer(settings)(
            means3D=model.xyz, means2D=points, opacities=torch.full((len(model.xyz), 1), 0.8).cuda(),
            colors_precomp=model.color, scales=torch.full((len(model.xyz), 3), 0.2).cuda(),
            rotations=torch.tensor([[1.0, 0, 0, 0]]).cuda().repeat(len(model.xyz), 1))
        return {"render": image, "radii": radii}
"""

MODEL = """
    import torch
    from simple_knn._C import distCUDA2

    class GaussianModel:
        def __init__(self):
            rng = torch.Generator().manual_seed(0)
            points = torch.rand(12, 3, generator=rng) - 0.5 + torch.tensor([0, 0, 2.0])
            assert (distCUDA2(points.cuda()) > 0).all()
            self.xyz = torch.nn.Parameter(points.cuda())
            self.color = torch.nn.Parameter(torch.rand(12, 3, generator=rng).cuda())

        def training_setup(self):
            self.optimizer = torch.optim.Adam([self.xyz, self.color], lr=0.01)

        def update_learning_rate(self, iteration):
            pass
"""

TRAIN = """
    import random, sys
    from types import SimpleNamespace
    import torch
    from gaussian_renderer import render
    from scene.gaussian_model import GaussianModel

    class Camera:
        def __init__(self, name, shade):
            self.image_name = name
            self.image = torch.full((3, 16, 16), shade, device="cuda")
            self.projection = torch.diag(torch.tensor([2.0, 2.0, 1.0, 0.0]))
            self.projection[2, 3] = 1.0

    def training(opt, out):
        gaussians = GaussianModel()
        gaussians.training_setup()
        first = 1
        if "--start" in sys.argv:
            (gaussians.xyz, gaussians.color), adam, first = torch.load(sys.argv[sys.argv.index("--start") + 1])
            gaussians.training_setup()
            gaussians.optimizer.load_state_dict(adam)
            first += 1
        name, more = "room" if "--room" in sys.argv else "view", 5.0 if "--bright" in sys.argv else 0.0
        cameras = [Camera(f"{name}{i}", more + 0.2 * i) for i in range(4)]
        scene = SimpleNamespace(model_path=out, getTrainCameras=lambda: cameras)
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        for iteration in range(first, opt.iterations + 1):
            start.record()
            gaussians.update_learning_rate(iteration)
            viewpoint_cam = random.Random(iteration).choice(cameras)
            loss = (render(viewpoint_cam, gaussians)["render"] - viewpoint_cam.image).abs().mean()
            if "--fail" in sys.argv and iteration == 5:
                sys.exit(3)
            loss.backward()
            end.record()
            if iteration < opt.densify_until_iter:
                pass  # densification
            torch.cuda.synchronize()
            gaussians.optimizer.step()
            gaussians.optimizer.zero_grad(set_to_none=True)
            if "--save" in sys.argv and iteration in (10, 40):
                saved = (gaussians.xyz, gaussians.color), gaussians.optimizer.state_dict(), iteration
                torch.save(saved, f"{out}/chkpnt{iteration}.pth")
        torch.save((gaussians.xyz, gaussians.color), out + "/model.pth")

    if __name__ == "__main__":
        random.seed(0)
        if "--idle" not in sys.argv:
            training(SimpleNamespace(iterations=60, densify_until_iter=20), sys.argv[1])
        print("Training complete.")
"""


@pytest.fixture
def checkout(tmp_path):
    """Path of the look-alike's train.py; forgets its modules afterwards."""
    folder = tmp_path / "checkout"
    (folder / "gaussian_renderer").mkdir(parents=True)
    (folder / "scene").mkdir()
    (folder / "gaussian_renderer" / "__init__.py").write_text(textwrap.dedent(RENDERER))
    (folder / "scene" / "__init__.py").write_text("")
    (folder / "scene" / "gaussian_model.py").write_text(textwrap.dedent(MODEL))
    (folder / "train.py").write_text(textwrap.dedent(TRAIN))
    yield str(folder / "train.py")
    forget()


def forget():
    for name in ("gaussian_renderer", "scene", "scene.gaussian_model"):
        sys.modules.pop(name, None)


def test_script_is_gated_on_the_cpu(checkout, tmp_path, capfd):
    before = torch.Tensor.backward
    code = cli.main(["run", "inria", "--cpu", "--warmup", "10", "--", checkout, str(tmp_path)])
    captured = capfd.readouterr()
    assert code == 0
    assert captured.out.endswith("Training complete.\n")  # the gate's own output goes to stderr
    assert "SkipGS: " in captured.err
    report = json.loads((tmp_path / "skipgs.json").read_text())
    assert report["iterations"] == 60 and report["gated_iterations"] == 41
    assert report["backwards_run"] + report["backwards_skipped"] == 41 and report["backwards_skipped"] > 0
    assert {row["view"] for row in report["views"]} <= {f"view{i}" for i in range(4)}
    assert report["settings"]["warmup"] == 10 and report["settings"]["start_iter"] == 20
    assert torch.Tensor.backward is before and "diff_gaussian_rasterization" not in sys.modules


def test_patched_lists_what_is_replaced_around_the_script_too(checkout, tmp_path, monkeypatch):
    names = (
        "save",
        "load",
        "cuda.is_available",
        "cuda.synchronize",
        "cuda.Event",
        "Tensor.backward",
        "optim.adam.adam",
    )
    before = {f"torch.{name}": resolve_name(f"torch.{name}") for name in names}
    seen = []

    def note(checkpoints, path):
        replaced = {name for name, own in before.items() if resolve_name(name) is not own}
        seen.append((set(checkpoints.gate.patched) & set(before), replaced))

    monkeypatch.setattr(Checkpoints, "_save_beside", note)
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 0
    assert seen == [(set(before), set(before))]
    assert all(resolve_name(name) is own for name, own in before.items())


def test_inert_and_never_skipping_train_bit_for_bit_alike(checkout, tmp_path):
    models = []
    for name, option in (("off", ["--no-gate"]), ("all", ["--min-bwd-ratio", "1.0"]), ("gated", ["--warmup", "5"])):
        (tmp_path / name).mkdir()
        assert cli.main(["run", "inria", "--cpu", *option, "--", checkout, str(tmp_path / name)]) == 0
        models.append(torch.load(tmp_path / name / "model.pth", weights_only=False))
        forget()
    off, never, gated = models
    assert all(torch.equal(a, b) for a, b in zip(off, never, strict=True))
    assert not torch.equal(off[0], gated[0])
    report = json.loads((tmp_path / "off" / "skipgs.json").read_text())
    assert report["settings"]["enabled"] is False and report["iterations"] == 60
    assert report["t_total"] > report["t_post"] > 0


def test_failing_script_keeps_its_code_and_leaves_a_report(checkout, tmp_path):
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path), "--fail"]) == 3
    assert json.loads((tmp_path / "skipgs.json").read_text())["iterations"] == 4


@pytest.mark.parametrize("rank", [0, 1])
def test_only_the_first_process_of_torchrun_reports(checkout, tmp_path, monkeypatch, capfd, rank):
    monkeypatch.setenv("RANK", str(rank))
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 0
    assert (tmp_path / "skipgs.json").exists() == ("SkipGS: " in capfd.readouterr().err) == (rank == 0)


class FullDisk(io.StringIO):
    def write(self, text):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_messages_that_cannot_be_written_end_no_training(checkout, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "stderr", FullDisk())
    (tmp_path / "model.pth.skipgs.json" / "in_the_way").mkdir(parents=True)  # the state cannot be written: a message
    assert cli.main(["run", "auto", "--cpu", "--", checkout, str(tmp_path)]) == 0
    assert json.loads((tmp_path / "skipgs.json").read_text())["iterations"] == 60


def test_without_a_gate_the_given_start_still_splits_the_time(checkout, tmp_path):
    command = ["run", "auto", "--no-gate", "--start-iter", "50", "--cpu", "--", checkout, str(tmp_path)]
    assert cli.main(command) == 0
    report = json.loads((tmp_path / "skipgs.json").read_text())
    assert report["settings"]["start_iter"] == 50 and report["t_total"] > report["t_post"] > 0


def test_script_that_ends_its_process_leaves_a_report_first(checkout, tmp_path, monkeypatch):
    def ended(status):
        assert json.loads((tmp_path / "skipgs.json").read_text())["iterations"] == 60
        raise SystemExit(status)

    monkeypatch.setattr(os, "_exit", ended)
    text = Path(checkout).read_text().replace('print("Training complete.")', "__import__('os')._exit(4)")
    Path(checkout).write_text(text)
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 4


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
def test_a_forked_child_that_ends_leaves_no_report(checkout, tmp_path):
    forks = "if iteration == 30 and os.fork() == 0: sys.exit()\n        if iteration == 40: sys.exit(os.wait()[1])\n"
    text = Path(checkout).read_text().replace("import random", "import os, random")
    Path(checkout).write_text(text.replace("        loss.backward()", f"        {forks}        loss.backward()"))
    command = [sys.executable, "-m", "skipgs_plug", "run", "inria", "--cpu", "--", checkout, str(tmp_path)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0 and run.stderr.count("SkipGS: ") == 1
    assert json.loads((tmp_path / "skipgs.json").read_text())["iterations"] == 39


def test_script_that_never_trains_keeps_its_code(checkout, tmp_path, capfd):
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path), "--idle"]) == 0
    assert "train.py ended without a training iteration; nothing was gated." in capfd.readouterr().err
    assert not (tmp_path / "skipgs.json").exists()


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
        (["inria", "--resume-gate", __file__, "--", __file__], "does not hold a gate state: give a file that ends in"),
        (["inria", "--ema-decay", "2", "--", __file__], "ema_decay must be in [0, 1)"),
    ],
)
def test_bad_input_is_one_sentence(arguments, sentence, capfd):
    assert cli.main(["run", *arguments]) == cli.BAD_INPUT
    error = capfd.readouterr().err
    assert sentence in error and error.count("\n") == 1


@pytest.fixture
def train(checkout, tmp_path):
    """Run the look-alike gated: its output folder, options for it, options of the gate; give exit code and folder."""

    def run(name, *options, gate=()):
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        code = cli.main(["run", "inria", "--cpu", "--warmup", "10", *gate, "--", checkout, str(folder), *options])
        forget()
        return code, folder

    return run


def counted(folder):
    report = json.loads((folder / "skipgs.json").read_text())
    return {name: report[name] for name in ("iterations", "gated_iterations", "backwards_skipped", "reasons")}


def test_gate_goes_on_with_the_scripts_own_checkpoint(train, capfd):
    _, whole = train("whole", "--save")
    state = whole / "chkpnt40.pth.skipgs.json"
    code, resumed = train("resumed", "--start", str(whole / "chkpnt40.pth"))
    assert code == 0 and f"The gate takes its state from {state}." in capfd.readouterr().err
    assert counted(resumed) == counted(whole)
    models = [torch.load(folder / "model.pth", weights_only=False) for folder in (whole, resumed)]
    assert all(torch.equal(a, b) for a, b in zip(*models, strict=True))

    _, afresh = train("afresh", "--start", str(whole / "chkpnt40.pth"), gate=["--resume-gate", "off"])
    assert counted(afresh)["iterations"] == 20 and counted(afresh)["reasons"]["warm-up"] == 10
    copied = state.rename(state.parent / "moved.json")
    _, given = train("given", "--start", str(whole / "chkpnt40.pth"), gate=["--resume-gate", str(copied)])
    assert counted(given) == counted(whole)


def test_a_checkpoint_may_be_an_open_file(checkout, train, capfd):
    script = Path(checkout)
    text = script.read_text()
    for call, mode in (("torch.save(saved, ", "wb"), ("torch.load(", "rb")):
        (line,) = (line.strip() for line in text.splitlines() if call in line)
        path = line.partition(call)[2][:-1]
        text = text.replace(line, f'with open({path}, "{mode}") as file: {line.replace(path, "file")}')
    script.write_text(text)
    _, whole = train("whole", "--save")
    code, resumed = train("resumed", "--start", str(whole / "chkpnt40.pth"))
    assert code == 0 and counted(resumed) == counted(whole)
    assert f"The gate takes its state from {whole / 'chkpnt40.pth.skipgs.json'}." in capfd.readouterr().err


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


def test_a_folder_named_like_a_gate_state_ends_no_training(train, tmp_path):
    (tmp_path / "beside").mkdir()
    (tmp_path / "beside" / "old.pth.skipgs.json").mkdir()
    code, folder = train("beside", "--save")
    assert code == 0 and (folder / "chkpnt40.pth.skipgs.json").is_file()


def test_what_cannot_be_written_beside_the_scripts_files_is_said_and_no_more(train, capfd, monkeypatch):
    def fails(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("skipgs_plug.scripts.checkpoints.write_aside", fails)
    monkeypatch.setattr("skipgs_plug.core.report.write_aside", fails)
    code, folder = train("full", "--save")
    error = capfd.readouterr().err
    assert code == 0 and (folder / "model.pth").exists() and not (folder / "skipgs.json").exists()
    assert "chkpnt40.pth.skipgs.json could not be written (OSError: [Errno 28] No space left on device)" in error
    assert "skipgs.json could not be written (OSError" in error and "Traceback" not in error


def test_gate_state_before_densification_ends_changes_nothing(train):
    _, whole = train("whole", "--save")
    _, resumed = train("resumed", "--start", str(whole / "chkpnt10.pth"))
    assert counted(resumed) == counted(whole)


def test_gate_state_of_another_scene_is_not_used(train, capfd):
    _, whole = train("whole", "--save")
    start = ["--start", str(whole / "chkpnt40.pth")]
    code, folder = train("room", *start, "--room")
    assert code == cli.BAD_INPUT and "belongs to another scene: it knows view 'view0'" in capfd.readouterr().err
    assert not (folder / "skipgs.json").exists()  # no iteration ran
    with pytest.warns(RuntimeWarning, match="belongs to another scene: up to iteration"):
        code, folder = train("bright", *start, "--bright")
    assert code == 0  # only the losses show it, so the gate is released and the run goes on
    assert counted(folder)["iterations"] == 40 + 10


def test_a_run_that_is_refused_leaves_the_report_of_the_run_before(train, monkeypatch):
    _, folder = train("whole", "--save")
    before = (folder / "skipgs.json").read_bytes()

    def refuses(*args):
        raise SkipGSError("This scene is refused.")

    monkeypatch.setattr(SkipPolicy, "decide", refuses)
    code, _ = train("whole", "--start", str(folder / "chkpnt40.pth"))
    assert code == cli.BAD_INPUT and (folder / "skipgs.json").read_bytes() == before


def test_a_report_that_cannot_be_written_is_one_sentence(train, tmp_path, capfd):
    (tmp_path / "blocked" / "skipgs.json").mkdir(parents=True)
    code, folder = train("blocked")
    sentence = "skipgs.json cannot be written (Is a directory): "
    assert code == 0 and (folder / "model.pth").exists() and capfd.readouterr().err.count(sentence) == 1


def test_gate_state_of_another_run_is_left_alone(train, capfd):
    _, whole = train("whole", "--save")
    state = whole / "chkpnt40.pth.skipgs.json"
    state.write_text(state.read_text().replace("train.py", "prune.py"))
    code, folder = train("other", "--start", str(whole / "chkpnt40.pth"))
    assert (
        code == 0
        and "belongs to iteration 40 of prune.py, but train.py starts with iteration 41" in capfd.readouterr().err
    )
    assert counted(folder)["iterations"] == 20
    code, _ = train("wrong", gate=["--resume-gate", str(state)])
    assert (
        code == cli.BAD_INPUT
        and "belongs to iteration 40, but the script continues with iteration 1" in capfd.readouterr().err
    )


def test_gate_states_go_with_their_checkpoints(train):
    _, off = train("off", "--save", gate=["--no-gate"])
    assert not list(off.glob("*.skipgs.json"))
    _, gated = train("gated", "--save")
    states = ["chkpnt10.pth.skipgs.json", "chkpnt40.pth.skipgs.json", "model.pth.skipgs.json"]
    assert sorted(path.name for path in gated.glob("*.skipgs.json")) == states
    (gated / "chkpnt10.pth").unlink()
    train("gated")
    assert sorted(path.name for path in gated.glob("*.skipgs.json")) == states[1:]


def test_auto_recognises_the_script_before_it_runs(checkout, tmp_path, capfd):
    assert cli.main(["run", "auto", "--cpu", "--warmup", "10", "--", checkout, str(tmp_path)]) == 0
    assert "skipgs-plug: train.py is run as inria." in capfd.readouterr().err
    assert json.loads((tmp_path / "skipgs.json").read_text())["settings"]["adapter"] == "inria"
    other = tmp_path / "other.py"
    other.write_text("def main():\n    pass\n")
    assert cli.main(["run", "auto", "--", str(other)]) == cli.BAD_INPUT
    error = capfd.readouterr().err
    assert "other.py, which has no function training(), but main: name the script that holds the training loop" in error
    assert "name one of" not in error and error.count("\n") == 1


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


def test_missing_extension_is_the_scripts_own_error(checkout, tmp_path, capfd):
    assert cli.main(["run", "inria", "--", checkout, str(tmp_path)]) == 1  # without --cpu there are no stand-ins
    error = capfd.readouterr().err
    assert "Traceback" in error and "gaussian_renderer/__init__.py" in error and "launch.py" not in error
    assert "diff_gaussian_rasterization is a CUDA extension of the trainer" in error
    assert "skipgs_plug[full]" not in error


def test_script_outside_its_checkout_is_said(checkout, tmp_path, capfd):
    lonely = tmp_path / "lonely" / "train.py"
    lonely.parent.mkdir()
    lonely.write_text(Path(checkout).read_text())
    assert cli.main(["run", "inria", "--cpu", "--", str(lonely), str(tmp_path)]) == 1
    assert "train.py is not in its checkout: its folder has no gaussian_renderer" in capfd.readouterr().err


def test_torch_keeps_to_one_thread_on_the_cpu(checkout, tmp_path, capfd):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        with open(checkout, "a") as script:
            script.write("    print('threads', torch.get_num_threads())\n")
        assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 0
        assert "threads 1\n" in capfd.readouterr().out and torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


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


@pytest.mark.parametrize("options", [[], ["--share", "auto"], ["--no-gate"]], ids=lambda options: " ".join(options))
def test_an_error_while_the_gate_attaches_lets_the_script_train(checkout, tmp_path, capfd, monkeypatch, options):
    def fails(*args, **kwargs):
        raise TypeError("of the adapter")

    monkeypatch.setattr(Hooks, "loop", fails)
    with pytest.warns(RuntimeWarning, match=r"goes on.*\(TypeError: of the adapter; report it to the project"):
        assert cli.main(["run", "inria", "--cpu", *options, "--", checkout, str(tmp_path)]) == 0
    error = capfd.readouterr().err
    assert (tmp_path / "model.pth").exists() and "Traceback" not in error and "nothing was gated" not in error


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


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("sh_degree=0,", "sh_degree=0, kernel_size=0.1,", "unexpected keyword argument 'kernel_size'"),
        ("means2D=points,", "means2D=points, means2D_densify=points,", "unexpected keyword argument 'means2D_densify'"),
        ("image, radii =", "image, radii, depth =", "not enough values to unpack (expected 3, got 2)"),
        (
            "import GaussianRasterizationSettings,",
            "import S, GaussianRasterizationSettings,",
            "import name 'S'",
        ),
        ("import torch\n", "import torch, diff_gaussian_rasterization._C\n", "No module named"),
        ("import torch\n", "import torch, diff_gaussian_rasterization as d; d._C.x\n", "no attribute '_C'"),
        (
            "import torch\n",
            "import torch, simple_knn._C as k; k.distCUDA2(torch.ones(9, 3), 4)\n",
            "takes 1 positional",
        ),
        ("import torch\n", "import torch, fused_ssim as f; f.fused_ssim(1, 2, window=3)\n", "argument 'window'"),
        ("return {", "settings.kernel_size; return {", "no attribute 'kernel_size'"),
        ("return {", "GaussianRasterizer(settings).integrate(model.xyz); return {", "no attribute 'integrate'"),
        ("return {", "GaussianRasterizer(settings).markVisible(); return {", "markVisible() missing 1 required"),
        (
            "image, radii = GaussianRasterizer(settings)(",
            "image, radii = (lambda *args, **kwargs: (out := GaussianRasterizer(settings)(*args, **kwargs), out[2]))(",
            "no output 2: the rasterizer has 2 outputs",
        ),
    ],
)
def test_what_the_stand_ins_lack_is_one_sentence(checkout, tmp_path, capfd, old, new, found):
    renderer = Path(checkout).parent / "gaussian_renderer" / "__init__.py"
    renderer.write_text(renderer.read_text().replace(old, new))
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 1
    error = capfd.readouterr().err
    assert "The script uses a feature that the stand-ins of --cpu lack (" in error and found in error
    assert "it needs CUDA; run it without --cpu." in error and "Traceback" not in error


def test_an_option_that_a_stand_in_refuses_is_one_sentence(checkout, tmp_path, capfd):
    renderer = Path(checkout).parent / "gaussian_renderer" / "__init__.py"
    renderer.write_text(renderer.read_text().replace("scales=", "cov3D_precomp=torch.ones(12, 6), scales="))
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 1
    error = capfd.readouterr().err
    assert "skipgs-plug: The CPU stand-in needs scales and rotations" in error and "Traceback" not in error


@pytest.mark.parametrize("line", ["(1, 2)[2]", "len(1, 2)", "None.integrate", "import simple_knx"])
def test_an_error_of_the_scripts_own_keeps_its_traceback(checkout, tmp_path, capfd, line):
    renderer = Path(checkout).parent / "gaussian_renderer" / "__init__.py"
    renderer.write_text(f"{line}\n" + renderer.read_text())
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 1
    error = capfd.readouterr().err
    assert "Traceback" in error and "stand-ins of --cpu" not in error


def test_no_advice_to_give_what_is_given(checkout, tmp_path, capfd):
    renderer = Path(checkout).parent / "gaussian_renderer" / "__init__.py"
    renderer.write_text("import diff_plane_rasterization\n" + renderer.read_text())
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 1
    error = capfd.readouterr().err
    assert "diff_plane_rasterization is a CUDA extension for which this adapter has no CPU stand-in" in error
    assert "with --cpu before" not in error


def test_a_resumed_run_without_a_state_says_so(train, capfd):
    _, off = train("off", "--save", gate=["--no-gate"])
    code, _ = train("on", "--start", str(off / "chkpnt40.pth"))
    state = off / "chkpnt40.pth.skipgs.json"
    assert code == 0 and f"The gate starts afresh in iteration 41: {state} does not exist." in capfd.readouterr().err
