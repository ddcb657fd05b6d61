"""Every command that attaches a gate takes its settings by the same names."""

from __future__ import annotations

import dataclasses

import pytest
import tyro

from skipgs_plug import SkipConfig, SkipGate, SkipGSError
from skipgs_plug.cli import main
from skipgs_plug.commands import run, train
from skipgs_plug.commands.gate_settings import GateSettings
from skipgs_plug.commands.options.gate import GateOptions
from skipgs_plug.trainer import InputError

GIVEN = {
    "start_iter": 7,
    "threshold": 0.1,
    "ema_decay": 0.5,
    "warmup": 3,
    "min_bwd_ratio": 0.25,
    "on_nonfinite": "raise",
    "pause_iters": 9,
    "share": 0.5,
    "grow_share": "auto",
    "refine_share": 0.25,
    "half_size": False,
    "max_gaussians": 1000,
    "always": (70, 80),
    "tolerance": 0.1,
    "compensate": True,
    "rate_peak": 3.0,
}
COMMANDS = pytest.mark.parametrize(
    ("args", "own"), [(run.Args, ["inria"]), (train.Args, ["scene", "--out", "folder"])], ids=["run", "train"]
)


def test_there_is_one_for_every_setting() -> None:
    assert set(GIVEN) == {field.name for field in dataclasses.fields(GateOptions)}
    assert set(GIVEN) | {"enabled"} == {field.name for field in dataclasses.fields(SkipConfig)}


@COMMANDS
def test_what_is_given_reaches_the_gate(args, own) -> None:
    options = []
    for name, value in GIVEN.items():
        options += [f"--{name.replace('_', '-')}", *map(str, value if isinstance(value, tuple) else [value])]
    config = (tyro.conf.FlagCreatePairsOff,)
    assert tyro.cli(args, args=[*own, *options], config=config).gate_options.given() == GIVEN
    assert tyro.cli(args, args=own, config=config).gate_options.given() == {}


@pytest.mark.parametrize("share", ["40%", "AUTO", "0,4", "2"])
def test_what_is_no_share_is_refused_in_one_sentence(share, tmp_path, capsys) -> None:
    (tmp_path / "photograph.jpg").touch()  # structure from motion would fail on it
    assert main(["train", str(tmp_path), "--sfm", "--out", str(tmp_path / "run"), "--refine-share", share]) == 2
    said = capsys.readouterr().err
    assert said.startswith('skipgs-plug: refine_share must be "auto" or in (0, 1], not ') and said.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "other"), [(["--tolerance", "0.1"], "--share auto"), (["--rate-peak", "5"], "--compensate True")]
)
@COMMANDS
def test_what_does_nothing_without_another_is_refused(args, own, options, other) -> None:
    given = tyro.cli(args, args=[*own, *options], config=(tyro.conf.FlagCreatePairsOff,)).gate_options
    with pytest.raises(SkipGSError, match=f"{options[0]} is for .*{other}; give"):
        given.given()
    assert dataclasses.replace(given, refine_share="auto").given()["refine_share"] == "auto"


def test_a_run_older_than_a_setting_was_begun_with_its_default() -> None:
    state = GateSettings(SkipGate(start_iter=10)).state_dict()
    del state["settings"]["tolerance"]
    GateSettings(SkipGate(start_iter=10)).load_state_dict(state)
    with pytest.raises(InputError, match=r"begun with gate\.tolerance=0\.05, not 0\.2"):
        GateSettings(SkipGate(start_iter=10, tolerance=0.2)).load_state_dict(state)
