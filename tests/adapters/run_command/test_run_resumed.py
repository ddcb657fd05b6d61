"""`skipgs-plug run`: the state of the gate beside the script's checkpoints, and the report."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import torch
from inria_checkout import counted

from skipgs_plug import SkipGSError, cli
from skipgs_plug.core.policy import SkipPolicy
from skipgs_plug.scripts.checkpoints import Checkpoints


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


def test_a_folder_named_like_a_gate_state_ends_no_training(train, tmp_path):
    (tmp_path / "beside").mkdir()
    (tmp_path / "beside" / "old.pth.skipgs.json").mkdir()
    code, folder = train("beside", "--save")
    assert code == 0 and (folder / "chkpnt40.pth.skipgs.json").is_file()


def test_files_that_cannot_be_written_are_named_and_training_goes_on(train, capfd, monkeypatch):
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


def test_a_resumed_run_without_a_state_says_so(train, capfd):
    _, off = train("off", "--save", gate=["--no-gate"])
    code, _ = train("on", "--start", str(off / "chkpnt40.pth"))
    sentence = f"The gate starts afresh in iteration 41: {off / 'chkpnt40.pth.skipgs.json'} does not exist."
    assert code == 0 and sentence in capfd.readouterr().err
    code, _ = train("share", "--start", str(off / "chkpnt40.pth"), gate=["--share", "0.5"])
    assert code == 0 and capfd.readouterr().err.count(sentence) == 1  # the loop's range asks, and its first iteration


def test_a_state_beside_a_later_checkpoint_of_another_run_is_not_used(train, capfd):
    _, folder = train("same", "--save")
    train("same", "--save", gate=["--no-gate"])  # it replaces the checkpoints, and leaves the states
    code, resumed = train("resumed", "--start", str(folder / "chkpnt40.pth"))
    state = folder / "chkpnt40.pth.skipgs.json"
    sentence = f"The gate starts afresh: {state} was saved beside another checkpoint of that name."
    assert code == 0 and sentence in capfd.readouterr().err and counted(resumed)["iterations"] == 20


@pytest.mark.parametrize("then", ["saved again", "moved away"])
def test_a_state_belongs_to_the_checkpoint_that_was_loaded(then, tmp_path):
    """Some scripts replace or remove their checkpoint after they have read it."""
    path, run = tmp_path / "latest.pth", ("inria", "train.py")
    saved = Checkpoints(*run)
    saved.gate = cast(
        "Any",
        SimpleNamespace(
            config=SimpleNamespace(enabled=True), stats=lambda: {"iterations": 10}, state_dict=lambda: {"step": 10}
        ),
    )
    with saved.watch():
        torch.save({"step": 10}, path)
    resumed = Checkpoints(*run)
    with resumed.watch():
        torch.load(path)
        if then == "saved again":
            torch.save({"step": 10, "resumed": True}, path)
        else:
            path.rename(tmp_path / "older.pth")
        assert resumed.state_for(11) == {"step": 10}


@pytest.mark.parametrize(
    ("option", "other", "sentence"),
    [
        ("iterations=60", "iterations=90", "that ends with iteration 60, not 90"),
        ("densify_until_iter=20", "densify_until_iter=30", "whose refinement begins at iteration 20, not 30"),
    ],
)
def test_a_run_that_goes_on_with_another_schedule_is_refused(checkout, train, capfd, option, other, sentence):
    share = ["--refine-share", "0.5"]
    _, folder = train("whole", "--save", gate=share)
    script = Path(checkout)
    script.write_text(script.read_text().replace(option, other))
    start = ["--start", str(folder / "chkpnt10.pth")]
    code, refused = train("refused", *start, gate=share)
    assert code == cli.BAD_INPUT and not (refused / "model.pth").exists()
    how = "continue with the schedule of that run, or start the gate afresh with --resume-gate off."
    assert f"The gate state was saved in a run {sentence}; {how}" in capfd.readouterr().err
    code, afresh = train("afresh", *start, gate=[*share, "--resume-gate", "off"])
    assert code == 0 and (afresh / "model.pth").exists()
