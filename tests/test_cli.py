"""The command: exit codes, one sentence per error, a run folder, Ctrl-C and resume, the demo."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from PIL import Image
from plyfile import PlyData

from skipgs_plug.cli import COMMANDS, WARNINGS, explain, main
from skipgs_plug.commands.demo import LEAST
from skipgs_plug.core.caution import GateWarning
from skipgs_plug.install import install_command
from skipgs_plug.messages import plain_warnings
from skipgs_plug.trainer import Trainer, save_packed
from skipgs_plug.trainer.synthetic import make_scene

SHORT = ["--max-steps", "60", "--refine-every", "10", "--no-progress"]


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("scene") / "tiny.npz"
    save_packed(make_scene(n_views=10, width=32, height=24, n_points=160), path)
    return str(path)


def one_sentence(capsys: pytest.CaptureFixture[str]) -> str:
    error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("skipgs-plug: ")]
    assert len(error) == 1
    return error[0]


def test_help_lists_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"• {name}" in shown for name in COMMANDS)
    assert main([]) == 2
    assert main(["tarin"]) == 2
    assert "no command 'tarin'" in one_sentence(capsys)


def test_the_shell_completes_commands_and_their_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--tyro-print-completion", "bash"]) == 0
    script = capsys.readouterr().out
    assert all(f"'{name}'" in script for name in COMMANDS)
    assert "--data-factor" in script and "--cameras" in script


def test_the_package_runs_as_a_module(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "skipgs_plug", "export", str(tmp_path / "none.ply"), "out.splat"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2 and "none.ply does not exist" in ended.stderr


def test_bad_input_is_one_sentence(tmp_path: Path, packed: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "run")
    assert main(["train", str(tmp_path / "nowhere"), "--out", out]) == 2
    assert "nowhere does not exist" in one_sentence(capsys)
    assert main(["train", packed, "--out", out, "--resume"]) == 2
    assert "start without --resume" in one_sentence(capsys)
    assert main(["train", packed, "--out", out, "--threshold", "-2", *SHORT]) == 2
    assert "threshold must be" in one_sentence(capsys)
    assert main(["train", packed, "--out", out, "--max-steps", "0"]) == 2
    assert not Path(out).exists()
    capsys.readouterr()
    assert main(["train", packed, "--out", out, "--resume", "--debug"]) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["train", "estimate"])
def test_a_missing_warp_is_said_before_the_scene_is_read(command: str, tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "run")] if command == "train" else []
    arguments = [command, str(tmp_path / "nowhere"), *out, "--backend", "warp"]
    # In a process of its own: a thread of an earlier command may be importing Warp in this one.
    code = f"import sys; sys.modules['warp'] = None; from skipgs_plug.cli import main; sys.exit(main({arguments}))"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert f"Backend warp needs NVIDIA Warp, which is not installed; run: {install_command()}" in ended.stderr


def test_a_missing_plyfile_is_said_before_training(
    tmp_path: Path, packed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "plyfile", None)
    assert main(["train", packed, "--out", str(tmp_path / "run"), *SHORT]) == 2
    assert f"needs the package plyfile; run: {install_command('train')}" in one_sentence(capsys)
    assert not (tmp_path / "run").exists()


def test_a_broken_package_is_named_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "plyfile.py").write_text("raise ImportError('libbroken.so: cannot open')")
    monkeypatch.delitem(sys.modules, "plyfile", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["train", str(tmp_path), "--out", str(tmp_path / "run"), *SHORT]) == 2
    said = one_sentence(capsys)
    assert "the package plyfile, which cannot be imported (libbroken.so: cannot open); run: pip install" in said


def test_the_import_that_failed_is_named_and_a_defect_of_this_package_keeps_its_traceback() -> None:
    def failed(cause: ImportError) -> ImportError:  # as the rasterizer raises it for users of Python
        error = ImportError("The CPU rasterizer needs NVIDIA Warp.")
        error.__cause__ = cause
        return error

    said = explain(failed(ModuleNotFoundError("No module named 'warp'", name="warp")), "view")
    assert said == f"This command needs the package warp; run: {install_command('view')}"
    assert explain(failed(ImportError("cannot import name", name="skipgs_plug.cli")), "view") is None


def test_run_folder(tmp_path: Path, packed: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    command = ["train", packed, "--out", str(out), "--tensorboard", "--warmup", "4", *SHORT]
    assert main(command) == 0
    shown = capsys.readouterr().out
    assert re.search(r"8 training views, 2 held out", shown) and "backwards skipped" in shown
    names = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert {
        "cfg.yml",
        "skipgs.json",
        "ckpts/ckpt_59_rank0.pt",
        "ply/point_cloud_59.ply",
        "stats/val_step59.json",
        "renders/val_step59_0000.png",
        "renders/val_step59_0001.png",
    } <= names
    assert any(name.startswith("tb/") for name in names)
    stats = json.loads((out / "stats/val_step59.json").read_text())
    assert len(PlyData.read(str(out / "ply/point_cloud_59.ply"))["vertex"]) == stats["num_GS"]
    report = json.loads((out / "skipgs.json").read_text())
    assert report["iterations"] == 60 and report["gated_iterations"] == 30
    assert report["settings"]["warmup"] == 4
    assert main(command) == 2
    assert "already holds a run" in one_sentence(capsys)


def test_interrupt_leaves_a_checkpoint_that_resume_continues(
    tmp_path: Path, packed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_step = Trainer.train_step

    def interrupted(self: Trainer) -> float:
        if self.step == 40:
            os.kill(os.getpid(), signal.SIGINT)
        return train_step(self)

    stopped, whole = tmp_path / "stopped", tmp_path / "whole"
    monkeypatch.setattr(Trainer, "train_step", interrupted)
    assert main(["train", packed, "--out", str(stopped), "--gate", *SHORT]) == 130
    assert [p.name for p in (stopped / "ckpts").iterdir()] == ["ckpt_40_rank0.pt"]
    assert not (stopped / "ply").exists()
    monkeypatch.setattr(Trainer, "train_step", train_step)
    assert main(["train", packed, "--out", str(stopped), "--gate", "--resume", *SHORT]) == 0
    assert main(["train", packed, "--out", str(whole), "--gate", *SHORT]) == 0
    ends = [torch.load(run / "ckpts/ckpt_59_rank0.pt", weights_only=True) for run in (stopped, whole)]
    for name in ends[0]["splats"]:
        assert torch.equal(ends[0]["splats"][name], ends[1]["splats"][name])
    reports = [json.loads((run / "skipgs.json").read_text()) for run in (stopped, whole)]
    for key in ("iterations", "gated_iterations", "backwards_run", "backwards_skipped", "views"):
        assert reports[0][key] == reports[1][key]


@pytest.mark.parametrize(
    ("options", "gated"),
    [([], False), (["--gate"], True), (["--refine-share", "0.4"], True), (["--warmup", "4"], True)],
)
def test_a_gate_is_attached_when_asked_for(
    tmp_path: Path, packed: str, options: list[str], gated: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["train", packed, "--out", str(tmp_path / "run"), *options, *SHORT]
    assert main(command) == 0
    assert ("gate active from 30" in capsys.readouterr().out) == gated
    assert (tmp_path / "run/skipgs.json").exists() == gated
    other = [word for word in command if word not in options] if gated else [*command, "--gate"]
    assert main([*other, "--resume"]) == 2
    assert f"begun with{'' if gated else 'out'} a gate; resume it with" in one_sentence(capsys)


def test_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "demo"
    size = ["--max-steps", "120", "--views", "10", "--width", "32", "--points", "200"]
    assert main(["demo", "--out", str(out), "--no-progress", *size]) == 0
    shown = capsys.readouterr().out
    names = ("own", "gate", "share=auto")
    rows = {line.split()[0]: line.split() for line in shown.splitlines() if len(line.split()) == 8}
    assert [int(cell) for cell in rows["own"][3:5]] == [120, 120]
    iterations, backwards = (int(cell) for cell in rows["gate"][3:5])
    assert iterations == 120 and 60 < backwards < 120
    report = json.loads((out / "share=auto" / "skipgs.json").read_text())
    assert report["settings"]["share"] == "auto" and int(rows["share=auto"][3]) == report["iterations"]
    with Image.open(out / "comparison.png") as comparison:
        assert comparison.size == (2 * 32 * 7, 2 * 24 * 2 + 16)  # 7 columns, 2 views, doubled, below a title line
    with Image.open(out / "refinement.png") as plot:
        assert plot.width > 500
    for name in names:
        assert len(PlyData.read(str(out / name / "ply/point_cloud_119.ply"))["vertex"]) > 0
        assert "\nframe:\n  centre:\n" in (out / name / "cfg.yml").read_text()


@pytest.mark.parametrize("option", ["--max-steps 1", "--views 1", "--width 14", "--points 3"])
def test_a_demo_that_is_too_small_is_refused_first(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", "--out", str(tmp_path / "demo"), *option.split()]) == 2
    assert f"{option} is too small for the demo; give at least" in one_sentence(capsys)
    assert not (tmp_path / "demo").exists()


def test_the_smallest_demo_runs(tmp_path: Path) -> None:
    least = [word for name, value in LEAST.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    assert main(["demo", "--out", str(tmp_path), "--no-progress", *least]) == 0


def test_photographs_that_do_not_exist(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video = str(tmp_path / "gone.mp4")
    assert main(["train", video, "--sfm", "--out", str(tmp_path / "run")]) == 2
    assert f"{video} does not exist; give a video or a folder with photographs" in one_sentence(capsys)


def test_doctor_renders(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor"]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"ok  warp +renders and differentiates on cpu", shown)
    assert ("python -m benchmarks.gpu" in shown) == torch.cuda.is_available()


def test_doctor_names_the_measurement_where_a_gpu_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "Imagined GPU")
    assert main(["doctor"]) == 0  # warp renders, which is enough; gsplat needs a driver
    named = re.search(r"python -m (benchmarks\.gpu) SCENE", capsys.readouterr().out)
    assert named and importlib.util.find_spec(named[1]) is not None


HEAVY = {"torch", "numpy", "warp", "gsplat", "pycolmap", "scipy", "matplotlib", "torchmetrics", "PIL", "viser", "tqdm"}
HEAVY |= {"typeguard", "unittest", "asyncio"}  # tyro loads it for types that it does not compare by itself
UNUSED_IN_TRAINING = {"torchmetrics", "matplotlib", "scipy.signal", "viser", "torchvision", "pycolmap"}


def loaded_by(code: str, heavy: set[str]) -> set[str]:
    """Return which of these modules a fresh process has loaded after some code."""
    code += f"\nimport sys\nsys.stderr.write('loaded:' + ' '.join(sorted({heavy!r} & set(sys.modules))))"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(ended.stderr.rpartition("loaded:")[2].split())


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_loads_nothing_heavy(command: str) -> None:
    arguments = [*command.split(), "--help"]
    code = f"from skipgs_plug.cli import main\ntry: main({arguments!r})\nexcept SystemExit: pass"
    assert loaded_by(code, HEAVY) == set()


def test_training_loads_nothing_that_it_does_not_use(tmp_path: Path, packed: str) -> None:
    arguments = ["train", packed, "--out", str(tmp_path / "run"), "--max-steps", "1", "--no-progress"]
    code = f"from skipgs_plug.cli import main\nassert main({arguments!r}) == 0"
    assert loaded_by(code, UNUSED_IN_TRAINING) == set()
    assert loaded_by(code.replace("== 0", "== 2"), {"torch"}) == {"torch"}  # loaded_by finds a module that is loaded


def test_the_collector_passes_over_what_a_program_has_loaded(packed: str, tmp_path: Path) -> None:
    arguments = ["skipgs-plug", "train", packed, "--out", str(tmp_path), "--max-steps", "1", "--no-progress"]
    code = (
        "import gc, sys\nfrom skipgs_plug.cli import main\n{before}\nassert {call} == 0\n"
        "assert gc.isenabled()\nprint('frozen', gc.get_freeze_count())"
    )

    def frozen(before: str, call: str) -> int:
        ended = subprocess.run(
            [sys.executable, "-c", code.format(before=before, call=call)], capture_output=True, text=True, check=True
        )
        return int(ended.stdout.rpartition("frozen")[2])

    pythons = 1_000  # more objects than Python itself exempts from collection: 375 with 3.12
    assert frozen(f"sys.argv = {arguments!r}", "main()") > 100_000
    # A caller in Python goes on, so nothing is exempted.
    assert frozen("", f"main({[*arguments[1:], '--resume']!r})") < pythons
    script = tmp_path / "script.py"
    script.write_text(f"import gc\nassert gc.isenabled() and gc.get_freeze_count() < {pythons}")
    assert frozen(f"sys.argv = {['skipgs-plug', 'run', 'inria', '--no-gate', '--', str(script)]!r}", "main()") < pythons


def test_the_home_folder_is_known_everywhere(monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    from skipgs_plug.cli import expand_home

    given = ["~/scene", "--out=~/runs", "--out", "~", "a~b", "--name=a~"]
    expected = ["/home/somebody/scene", "--out=/home/somebody/runs", "--out", "/home/somebody", "a~b", "--name=a~"]
    assert [expand_home(argument) for argument in given] == expected


def test_names_that_the_locale_cannot_print(tmp_path: Path, packed: str) -> None:
    scene = tmp_path / "Lübeck \u732b.npz"
    scene.write_bytes(Path(packed).read_bytes())
    arguments = ["train", str(scene), "--out", str(tmp_path / "l\u00e4uft"), "--max-steps", "1", "--no-progress"]
    code = f"from skipgs_plug.cli import main; raise SystemExit(main({arguments!r}))"
    narrow = {**os.environ, "PYTHONIOENCODING": "ascii:strict"}
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, env=narrow)
    assert ended.returncode == 0, ended.stderr
    assert b"l\\xe4uft" in ended.stdout


def test_warnings_of_the_gate_are_printed_as_sentences_and_others_as_ever() -> None:
    before = warnings.formatwarning
    with plain_warnings(WARNINGS):
        assert warnings.formatwarning(GateWarning("One."), GateWarning, "a.py", 3) == "skipgs-plug: One.\n"
        assert warnings.formatwarning(UserWarning("Two."), UserWarning, "a.py", 3, "x") == before(
            UserWarning("Two."), UserWarning, "a.py", 3, "x"
        )
    assert warnings.formatwarning is before
