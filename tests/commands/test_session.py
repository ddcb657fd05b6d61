"""A run that is killed, stopped, starved of disk space or shared loses nothing, and ends as if nothing happened."""

from __future__ import annotations

import errno
import logging
import os
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.optim.optimizer import _global_optimizer_pre_hooks
from tqdm.auto import tqdm

from benchmarks import soak_runs
from skipgs_plug.cli import main
from skipgs_plug.trainer import Trainer, View, save_packed
from skipgs_plug.trainer.synthetic import make_scene

OPTIONS = ["--max-steps", "60", "--refine-every", "10", "--no-progress", "--warmup", "6", "--save-every", "20"]


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("scene") / "tiny.npz"
    save_packed(make_scene(n_views=10, width=32, height=24, n_points=160), path)
    return str(path)


@pytest.fixture(scope="module")
def whole(packed: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was not interrupted."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert train(packed, out) == 0
    return out


def train(packed: str, out: Path, *more: str) -> int:
    return main(["train", packed, "--out", str(out), *OPTIONS, *more])


def checkpoints(out: Path) -> list[str]:
    return sorted(path.name for path in (out / "ckpts").iterdir())


def assert_same(out: Path, whole: Path) -> None:
    """Same files, same bytes of models and pictures, same moments and decisions; of gated runs."""
    assert (whole / "skipgs.json").is_file()
    soak_runs.assert_same(out, whole, steps=60)


def fail_to_write(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Let the disk be full for files whose name contains one of these."""
    replace = os.replace

    def full(source: str | Path, target: str | Path) -> None:
        if any(name in str(target) for name in names):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(source))
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)


def test_checkpoints_on_the_way_and_the_last_two_stay(whole: Path) -> None:
    assert checkpoints(whole) == ["ckpt_39_rank0.pt", "ckpt_59_rank0.pt"]
    assert not [path for path in whole.rglob(".*") if path.name != ".lock"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_a_checkpoint(
    tmp_path: Path, packed: str, whole: Path, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = Trainer.save_checkpoint

    def interrupted(self: Trainer, path: Path) -> None:
        save(self, path)
        if self.step == 20:  # during a save
            os.kill(os.getpid(), number)

    handlers = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "save_checkpoint", interrupted)
        assert train(packed, tmp_path / "run") == 128 + number
    assert [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert checkpoints(tmp_path / "run") == ["ckpt_19_rank0.pt"]
    assert train(packed, tmp_path / "run", "--resume") == 0
    assert_same(tmp_path / "run", whole)


def test_a_second_signal_ends_at_once_and_keeps_what_was_saved(
    tmp_path: Path, packed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_step = Trainer.train_step

    def interrupted(self: Trainer) -> float:
        if self.step == 30:
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)
        return train_step(self)

    monkeypatch.setattr(Trainer, "train_step", interrupted)
    assert train(packed, tmp_path) == 130
    assert checkpoints(tmp_path) == ["ckpt_19_rank0.pt"]


@pytest.mark.parametrize("lost", ["ply/", "renders/", "stats/", "skipgs.json"])
def test_a_finished_run_is_completed(tmp_path: Path, packed: str, whole: Path, lost: str) -> None:
    """Kill a run while it writes its results, with a half-written temporary file."""
    out = tmp_path / "run"
    subprocess.run(["cp", "-r", str(whole), str(out)], check=True)
    for path in [
        path for path in out.rglob("*") if path.relative_to(out).as_posix().startswith(lost) and path.is_file()
    ]:
        path.rename(path.with_name(f".{path.name}.4711.tmp"))
    (out / ".skipgs.json.4711").write_text("{")
    assert train(packed, out, "--resume") == 0
    assert_same(out, whole)


def test_when_nobody_reads_any_more_a_checkpoint_is_left(
    tmp_path: Path, packed: str, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, command = tmp_path / "run", [option for option in OPTIONS if option != "--no-progress"]

    def unread(self: tqdm, n: float | None = 1) -> None:
        self.n += n or 0
        if self.n >= 33:
            raise BrokenPipeError

    with monkeypatch.context() as patch:
        patch.setattr(tqdm, "update", unread)
        assert main(["train", packed, "--out", str(out), *command]) == 141
    assert checkpoints(out)[-1] == "ckpt_32_rank0.pt"
    assert train(packed, out, "--resume") == 0
    assert_same(out, whole)


def test_a_full_disk_costs_one_checkpoint(
    tmp_path: Path, packed: str, whole: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    fail_to_write(monkeypatch, "ckpt_19_", "ckpt_39_")
    assert train(packed, tmp_path / "run") == 0
    assert checkpoints(tmp_path / "run") == ["ckpt_59_rank0.pt"]
    sentences = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(sentences) == 2 and all("it needs about 0." in sentence for sentence in sentences)
    assert "ckpt_19_rank0.pt cannot be written (No space left on device)" in sentences[0]
    assert_same(tmp_path / "run", whole)


def test_at_the_end_each_view_is_rendered_once_and_kept_as_it_was_measured(
    tmp_path: Path, packed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rendered, render = [], Trainer.render

    def counted(self: Trainer, view: View) -> Tensor:
        image = render(self, view)
        rendered.append((view, image))
        return image

    monkeypatch.setattr(Trainer, "render", counted)
    assert train(packed, tmp_path) == 0
    names = [view.name for view, _ in rendered]
    assert len(names) == len(set(names)) == 2
    for i, (view, image) in enumerate(rendered):
        with Image.open(tmp_path / f"renders/val_step59_{i:04d}.png") as picture:
            photograph, shown = np.split(np.asarray(picture), 2, axis=1)
        np.testing.assert_array_equal(photograph, view.image)
        np.testing.assert_array_equal(shown, (image.clamp(0, 1) * 255).round().byte())


def test_a_full_disk_costs_the_renders_and_not_the_evaluation(
    tmp_path: Path, packed: str, whole: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as patch:
        fail_to_write(patch, "val_step59_0000.png")
        assert train(packed, tmp_path / "run") == 2
    assert "1 file of" in capsys.readouterr().err
    assert (tmp_path / "run/stats/val_step59.json").is_file()
    assert train(packed, tmp_path / "run", "--resume") == 0
    assert_same(tmp_path / "run", whole)


def test_a_full_disk_at_the_end_costs_those_files(
    tmp_path: Path, packed: str, whole: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as patch:
        fail_to_write(patch, ".ply", "skipgs.json")
        assert train(packed, tmp_path / "run") == 2
    assert "2 files of" in capsys.readouterr().err
    assert (tmp_path / "run/stats/val_step59.json").is_file() and (tmp_path / "run/renders").is_dir()
    assert train(packed, tmp_path / "run", "--resume") == 0
    assert_same(tmp_path / "run", whole)


def test_a_full_disk_that_leaves_no_checkpoint_does_not_promise_to_resume(
    tmp_path: Path, packed: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as patch:
        fail_to_write(patch, "ckpt_", ".ply")
        assert train(packed, tmp_path / "run") == 2
    error = capsys.readouterr().err
    assert "no checkpoint" in error and "another --out, without --resume" in error
    assert train(packed, tmp_path / "other", "--max-steps", "4") == 0


def test_a_run_is_not_mixed_with_an_older_one(
    tmp_path: Path, packed: str, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    shutil.copytree(whole, out)
    shutil.rmtree(out / "ckpts")
    for removed in ("ply", "stats", "renders"):  # at last, skipgs.json alone is left
        assert train(packed, out) == 2
        assert "files of a run without a checkpoint" in capsys.readouterr().err
        shutil.rmtree(out / removed)
    (out / "skipgs.json").unlink()
    (out / "settings.json").write_text("{}")
    assert train(packed, out) == 2 and "holds a bench, with which a run would be mixed" in capsys.readouterr().err
    (out / "settings.json").unlink()
    assert train(packed, out, "--max-steps", "4") == 0


def test_the_next_command_can_be_pasted(tmp_path: Path, packed: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "my $run"
    assert train(packed, out, "--max-steps", "4") == 0
    command = capsys.readouterr().out.splitlines()[-1].partition("Next: ")[2]
    assert shlex.split(command)[-2:] == ["view", str(out)]


def test_a_damaged_checkpoint_gives_way_to_the_one_before(
    tmp_path: Path, packed: str, whole: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    subprocess.run(["cp", "-r", str(whole), str(out)], check=True)
    newest, older = out / "ckpts/ckpt_59_rank0.pt", out / "ckpts/ckpt_39_rank0.pt"
    newest.write_bytes(newest.read_bytes()[:-5000])
    assert train(packed, out, "--resume") == 0
    assert "Trying ckpt_39_rank0.pt" in caplog.text and "iterations 40 to 60" in capsys.readouterr().out
    assert_same(out, whole)
    content = torch.load(newest, weights_only=True)  # only the gate's part is damaged, which only the gate checks
    content["registered"]["skipgs"]["policy"]["budget"]["floor"] = "high"
    torch.save(content, newest)
    assert train(packed, out, "--resume") == 0
    assert_same(out, whole)
    for path in (newest, older):
        path.write_bytes(b"")
    assert train(packed, out, "--resume") == 2
    assert "ckpt_39_rank0.pt is damaged" in capsys.readouterr().err


def test_a_run_is_extended(tmp_path: Path, packed: str, whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    subprocess.run(["cp", "-r", str(whole), str(out)], check=True)
    extend = ["train", packed, "--out", str(out), *OPTIONS[2:], "--resume"]
    assert main([*extend, "--max-steps", "70", "--eval-every", "5"]) == 0
    shown = capsys.readouterr().out
    assert "iterations 60 to 70, gate active from 30" in shown and "Iteration 64: PSNR" in shown
    assert (out / "ply/point_cloud_69.ply").is_file() and (out / "stats/val_step64.json").is_file()
    assert main(extend) == 0  # without a number it ends where it ended
    assert "iterations 70 to 70" in capsys.readouterr().out
    assert main([*extend, "--max-steps", "50"]) == 2
    assert "more than max_steps=50" in capsys.readouterr().err


def test_a_run_whose_rates_fall_to_0_is_not_extended(
    tmp_path: Path, packed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    train = ["train", packed, "--out", str(tmp_path / "run"), "--max-steps", "20", "--no-progress"]
    share = ["--share", "0.5"]
    assert main([*train, *share]) == 0
    assert main([*train, *share, "--resume", "--max-steps", "30"]) == 2
    assert "learning rates fall to 0 at iteration 20" in capsys.readouterr().err
    own_rates = ["--refine-share", "0.5", "--compensate", "False"]
    train[3] = str(tmp_path / "own rates")
    assert main([*train, *own_rates]) == main([*train, *own_rates, "--resume", "--max-steps", "30"]) == 0


@pytest.mark.filterwarnings("ignore:Leave out .*warmup")  # warmup is among OPTIONS
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--threshold", "0.1"], r"gate.threshold=0.0, not 0.1"),
        (["--refine-share", "0.5"], r"gate.refine_share=None, not 0.5"),
        (["--sh0-lr", "0.1"], r"sh0_lr=0.0025, not 0.1"),
    ],
)
def test_other_settings_are_refused(
    packed: str,
    whole: Path,
    options: list[str],
    sentence: str,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    assert train(packed, whole, "--resume", *options) == 2
    assert sentence in capsys.readouterr().err and not caplog.records  # no checkpoint is called damaged


def test_two_processes_do_not_share_a_folder(tmp_path: Path, packed: str, capsys: pytest.CaptureFixture[str]) -> None:
    code = (
        "import sys, pathlib; from skipgs_plug.trainer.lock import exclusive\n"
        "with exclusive(pathlib.Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"held\n"
        assert train(packed, tmp_path) == 2
        assert f"is in use by process {other.pid} on {os.uname().nodename}" in capsys.readouterr().err
        other.kill()
    assert (tmp_path / ".owner.json").is_file()  # the killed process left it behind, which does no harm
    assert train(packed, tmp_path, "--max-steps", "2") == 0
    assert not (tmp_path / ".owner.json").exists()


@pytest.mark.parametrize("out", ["file", "file/run", "closed/run", "link", "link/run"])
def test_a_folder_that_cannot_be_written_is_one_sentence_before_the_scene_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "closed").mkdir()
    (tmp_path / "link").symlink_to("nowhere")
    monkeypatch.setattr(os, "access", lambda path, mode: path.name != "closed")  # root may write everywhere
    assert train("no scene", tmp_path / out) == 2
    error = capsys.readouterr().err
    place = out.split("/")[0]
    fault = {"file": "is a file", "closed": "cannot be written", "link": "is a link to nothing"}[place]
    assert f"{tmp_path / place} {fault}" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "closed/run").exists() and not (tmp_path / "nowhere").exists()


def test_photographs_too_small_to_be_halved_are_refused_before_a_folder_is_made(
    tmp_path: Path, packed: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skipgs_plug.adapters.reference_trainer.can_be_halved", lambda height, width: False)
    assert main(["train", packed, "--out", str(tmp_path / "run"), "--share", "0.5", "--half-size", "True"]) == 2
    assert "half_size is not possible here" in capsys.readouterr().err and not (tmp_path / "run").exists()


def test_a_run_folder_that_vanishes_is_made_anew(
    tmp_path: Path, packed: str, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_step, out = Trainer.train_step, tmp_path / "run"

    def vanishing(self: Trainer) -> float:
        if self.step == 30:
            shutil.rmtree(out)
        return train_step(self)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "train_step", vanishing)
        assert train(packed, out) == 0
    assert checkpoints(out) == checkpoints(whole)[-2:]
    assert (out / "ply/point_cloud_59.ply").read_bytes() == (whole / "ply/point_cloud_59.ply").read_bytes()
    assert train(packed, out, "--resume") == 0


@pytest.mark.filterwarnings("ignore:Leave out .*warmup")  # warmup is among OPTIONS
def test_nothing_of_the_gate_stays_behind_in_the_process(packed: str, tmp_path: Path) -> None:
    before = dict(_global_optimizer_pre_hooks)
    assert train(packed, tmp_path / "run", "--refine-share", "0.5") == 0
    assert before == dict(_global_optimizer_pre_hooks)
