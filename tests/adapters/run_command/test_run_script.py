"""`skipgs-plug run`: the script is gated, and keeps its output, files and exit code."""

import errno
import io
import json
import os
import subprocess
import sys
from pathlib import Path
from pkgutil import resolve_name

import pytest
import torch
from inria_checkout import forget

from skipgs_plug import cli
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.scripts.checkpoints import Checkpoints


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


def test_patched_also_lists_names_that_are_replaced_around_the_script(checkout, tmp_path, monkeypatch):
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

    def note(checkpoints, path, contents):
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


def test_the_report_lies_beside_the_model_though_the_script_changes_its_working_folder(checkout, tmp_path, monkeypatch):
    (tmp_path / "outputs" / "model").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    text = Path(checkout).read_text().replace("import random, sys", "import os, random, sys; os.chdir('outputs')")
    Path(checkout).write_text(text.replace('print("Training complete.")', 'os.chdir("..")'))  # as Hydra does
    assert cli.main(["run", "auto", "--cpu", "--", checkout, "model"]) == 0
    assert (tmp_path / "outputs" / "model" / "model.pth").exists()
    assert (tmp_path / "outputs" / "model" / "skipgs.json").exists()


def test_script_that_never_trains_keeps_its_code(checkout, tmp_path, capfd):
    assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path), "--idle"]) == 0
    said = "train.py ended without a training iteration that adapter 'inria' knows; nothing was gated."
    assert said in capfd.readouterr().err
    assert not (tmp_path / "skipgs.json").exists()


@pytest.mark.parametrize("option", ["--share", "--refine-share=0.3", "--cpu"])
def test_an_option_behind_the_dashes_is_named_if_the_script_refuses_it(option, checkout, tmp_path, capfd):
    script = Path(checkout)
    script.write_text(script.read_text().replace("random.seed(0)", "len(sys.argv) > 2 and sys.exit(2)"))
    assert cli.main(["run", "auto", "--cpu", "--", checkout, str(tmp_path), option]) == 2
    assert f"If {option} was meant for skipgs-plug, write it before '--'." in capfd.readouterr().err


def test_a_script_without_the_dashes_is_said(checkout, tmp_path, capfd):
    assert cli.main(["run", "auto", "--share", "auto", checkout, str(tmp_path)]) == cli.BAD_INPUT
    assert f"Write '--' before the script: skipgs-plug run auto ... -- {checkout} ..." in capfd.readouterr().err


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


@pytest.mark.parametrize("options", [[], ["--share", "auto"], ["--no-gate"]], ids=lambda options: " ".join(options))
def test_an_error_while_the_gate_attaches_lets_the_script_train(checkout, tmp_path, capfd, monkeypatch, options):
    def fails(*args, **kwargs):
        raise TypeError("of the adapter")

    monkeypatch.setattr(Hooks, "loop", fails)
    with pytest.warns(RuntimeWarning, match=r"goes on.*\(TypeError: of the adapter; report it to the project"):
        assert cli.main(["run", "inria", "--cpu", *options, "--", checkout, str(tmp_path)]) == 0
    error = capfd.readouterr().err
    assert (tmp_path / "model.pth").exists() and "Traceback" not in error and "nothing was gated" not in error


def rewritten(checkout, main):
    """Replace the last lines of the look-alike, which call `training`."""
    file = Path(checkout)
    text = file.read_text()
    head = text[: text.index('if __name__ == "__main__":')]
    file.write_text(f"{head}options = SimpleNamespace(iterations=60, densify_until_iter=20)\n{main}\n")


def run_alone(checkout, tmp_path, *options):
    """Run the look-alike in a new process, which may end at once."""
    command = [sys.executable, "-m", "skipgs_plug", "run", "inria", "--cpu", *options, "--", checkout, str(tmp_path)]
    root = Path(__file__).parents[3]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(root)})


STARTED = """
if __name__ == "__main__":
    import multiprocessing
    process = multiprocessing.get_context("{}").Process(target=training, args=(options, sys.argv[1]))
    process.start()
    process.join()
"""


def test_a_process_that_the_script_forks_is_gated_and_reports(checkout, tmp_path):
    rewritten(checkout, STARTED.format("fork"))
    ended = run_alone(checkout, tmp_path)
    assert ended.returncode == 0 and "nothing was gated" not in ended.stderr, ended.stderr
    assert json.loads((tmp_path / "skipgs.json").read_text())["iterations"] == 60
    assert ended.stderr.count("SkipGS: ") == 1


def test_a_process_that_the_script_spawns_says_that_it_is_not_gated(checkout, tmp_path):
    rewritten(checkout, STARTED.format("spawn"))
    ended = run_alone(checkout, tmp_path)
    assert ended.returncode == 0 and (tmp_path / "model.pth").exists(), ended.stderr
    assert "training() called backward in a process that train.py has spawned, which no gate reaches." in ended.stderr
    assert not (tmp_path / "skipgs.json").exists()
    assert "which no gate reaches" not in run_alone(checkout, tmp_path, "--no-gate").stderr


def test_a_script_that_restarts_itself_before_it_trains_is_refused(checkout, tmp_path):
    rewritten(checkout, "import os\nos.execv(sys.executable, [sys.executable, '-c', 'print(5)'])")
    ended = run_alone(checkout, tmp_path)
    assert ended.returncode == 2 and ended.stdout == ""
    assert "in the place of its process before it trains, and no gate reaches that program" in ended.stderr
    assert run_alone(checkout, tmp_path, "--no-gate").stdout == "5\n"


def test_a_script_that_ends_by_another_program_leaves_a_report(checkout, tmp_path):
    end = "import os\nos.execv(sys.executable, [sys.executable, '-c', 'exit(4)'])"
    rewritten(checkout, f"training(options, sys.argv[1])\n{end}")
    ended = run_alone(checkout, tmp_path)
    assert ended.returncode == 4 and ended.stderr.count("SkipGS: ") == 1, ended.stderr
    assert json.loads((tmp_path / "skipgs.json").read_text())["iterations"] == 60


def test_the_report_of_two_runs_in_one_process_lies_with_the_first(checkout, tmp_path):
    rewritten(checkout, "for run in 'ab':\n    training(options, f'{sys.argv[1]}/{run}')")
    for run in "ab":
        (tmp_path / run).mkdir()
    with pytest.warns(RuntimeWarning, match="as in a second training run"):
        assert cli.main(["run", "inria", "--cpu", "--", checkout, str(tmp_path)]) == 0
    assert json.loads((tmp_path / "a" / "skipgs.json").read_text())["iterations"] == 60
    assert (tmp_path / "b" / "model.pth").exists() and not (tmp_path / "b" / "skipgs.json").exists()


@pytest.mark.parametrize("by_path", [False, True])
def test_a_command_that_a_package_provides_is_gated(checkout, tmp_path, monkeypatch, by_path):
    """Its loop is in the module of its function, which iterations are left out of."""
    rewritten(checkout, "def entry():\n    training(options, sys.argv[1])")
    facts = tmp_path / "train_lookalike-1.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: train-lookalike\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text("[console_scripts]\ntrain-lookalike = train:entry\n")
    command = tmp_path / "bin" / "train-lookalike"
    command.parent.mkdir()
    command.write_text("import sys\nfrom train import entry\nsys.exit(entry())\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(Path(checkout).parent)
    monkeypatch.setattr(sys, "executable", str(command.parent / "python"))
    name = str(command) if by_path else command.name
    assert cli.main(["run", "auto", "--cpu", "--refine-share", "0.5", "--", name, str(tmp_path)]) == 0
    report = json.loads((tmp_path / "skipgs.json").read_text())
    assert report["iterations_skipped"] > 0 and report["iterations"] < 60
    del sys.modules["train"]
