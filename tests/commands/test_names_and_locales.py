"""Names that the locale has no letters for, arguments that are no UTF-8, and `~`, in every command."""

from __future__ import annotations

import dataclasses
import importlib
import os
import re
import shutil
import subprocess
import sys
import typing
from pathlib import Path

import pytest
from PIL import Image

from skipgs_plug.cli import COMMANDS, main
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.synthetic import make_scene

SHORT = ["--max-steps", "6", "--no-progress"]
LATIN = os.fsdecode(b"sc\xe9ne")  # Python passes arguments that are not UTF-8 in this form


def write_colmap(root: Path, name: str = "view", binary: bool = False) -> Path:
    """Write a model of ten 32x24 images."""
    from scipy.spatial.transform import Rotation

    scene = make_scene(n_views=10, width=32, height=24, n_points=60)
    model = root / "sparse/0"
    model.mkdir(parents=True)
    (root / "images").mkdir()
    K = scene.train[0].K
    (model / "cameras.txt").write_text(f"1 PINHOLE 32 24 {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    lines = []
    for number, view in enumerate(scene.train + scene.test, 1):
        Image.fromarray(view.image.numpy()).save(root / "images" / f"{name}_{number:02d}.png")
        x, y, z, w = Rotation.from_matrix(view.viewmat[:3, :3].numpy()).as_quat()
        pose = " ".join(map(repr, map(float, (w, x, y, z, *view.viewmat[:3, 3].tolist()))))
        lines += [f"{number} {pose} 1 {name}_{number:02d}.png", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = (f"{i} {x} {y} {z} 9 9 9 0" for i, (x, y, z) in enumerate(scene.points.tolist(), 1))
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    if binary:
        import_pycolmap().Reconstruction(str(model)).write_binary(str(model))
        for path in model.glob("*.txt"):
            path.unlink()
    return root


@pytest.mark.timeout(1800)  # five processes, each of which loads torch
@pytest.mark.parametrize("strict", [False, True], ids=["POSIX", "ASCII"])
def test_every_locale(tmp_path: Path, strict: bool) -> None:
    """Python itself uses `strict` under every locale except C and POSIX, such as de_DE.ISO-8859-1."""
    scene = write_colmap(tmp_path / "Straße", "Bäume")
    env = {name: value for name, value in os.environ.items() if not name.startswith(("LC_", "LANG", "PYTHONUTF8"))}
    env |= {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"} if strict else {"LC_ALL": "POSIX"}
    if strict:
        found = [sys.executable, "-c", "import sys; print(sys.getfilesystemencoding())"]
        assert subprocess.run(found, env=env, capture_output=True, text=True).stdout.strip() == "ascii"
    run = tmp_path / "Läufe/eins"
    bench = ["--out", tmp_path / "Vergleich ö", "--seeds", "0", "--policies", "own", "gate"]
    commands = {
        "train": [scene, "--out", run, "--gate", *SHORT],
        "report": [run, "--out", tmp_path / "Bericht.html"],
        "bench": [scene, *bench, "--max-steps", "40", "--no-progress"],
    }
    for name in commands if strict else ("train", "report"):
        command = [sys.executable, "-m", "skipgs_plug", name, *map(str, commands[name])]
        done = subprocess.run(command, env=env, capture_output=True)
        assert done.returncode == 0, done.stderr.decode("utf-8", "replace")
        assert b"Traceback" not in done.stderr
    assert "Bäume_0" in (run / "skipgs.json").read_text("utf-8").encode().decode("unicode_escape")
    assert "eins" in (tmp_path / "Bericht.html").read_text("utf-8")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_arguments_that_are_no_utf8(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = write_colmap(tmp_path / LATIN, binary=True)
    run, bench = tmp_path / f"run {LATIN}", tmp_path / f"bench {LATIN}"
    assert main(["train", str(scene), "--out", str(run), "--gate", *SHORT]) == 0, capsys.readouterr().err
    assert (
        main(["train", str(scene), "--out", str(run), "--gate", "--resume", "--max-steps", "8", "--no-progress"]) == 0
    )
    options = ["--seeds", "0", "--policies", "own", "gate", "--max-steps", "40", "--no-progress"]
    assert main(["bench", str(scene), "--out", str(bench), *options]) == 0, capsys.readouterr().err
    page = tmp_path / f"{LATIN}.html"
    assert main(["report", str(run), str(bench), "--out", str(page)]) == 0, capsys.readouterr().err
    assert r"run sc\xe9ne" in page.read_text("utf-8")
    for ending in (".ply", ".spz", ".splat"):
        out = tmp_path / f"{LATIN}{ending}"
        assert main(["export", str(run), str(out)]) == 0
        assert out.stat().st_size > 0
    pictures = tmp_path / f"pictures {LATIN}"
    assert main(["render", str(run), str(pictures), "--frames", "1", "--no-progress"]) == 0
    assert len(list(pictures.iterdir())) == 1
    assert main(["train", str(tmp_path / f"no{LATIN}"), "--out", str(tmp_path / "none")]) == 2
    assert "does not exist" in capsys.readouterr().err


def text_options(kind: type) -> list[tuple[str, str]]:
    """Return (name of the field, argument) of everything that a command takes as text or path."""
    hints = typing.get_type_hints(kind, include_extras=True)
    result = []
    for field in dataclasses.fields(kind):
        hint, marks = hints[field.name], str(hints[field.name])
        if "Suppress" in marks:
            continue
        plain = typing.get_args(hint)[0] if typing.get_origin(hint) is typing.Annotated else hint
        if dataclasses.is_dataclass(plain):
            result += text_options(typing.cast(type, plain))
        elif re.search(r"\b(str|Path)\b", str(plain)) and "Literal" not in str(plain):
            result.append((field.name, "" if "Positional" in marks else f"--{field.name.replace('_', '-')}"))
    return result


def values_of(args: object, name: str) -> list[str]:
    """Return the value of the field with this name, in `args` or in one of its dataclasses."""
    for field in dataclasses.fields(args):  # type: ignore[arg-type]
        value = getattr(args, field.name)
        if field.name == name:
            return list(map(str, value)) if isinstance(value, tuple) else [str(value)]
        if dataclasses.is_dataclass(value) and name in str(value):
            return values_of(value, name)
    raise KeyError(name)


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "doctor"])
def test_the_home_folder_in_every_option(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    monkeypatch.setenv("USERPROFILE", "/home/somebody")
    options = importlib.import_module(f"skipgs_plug.commands.options.{command}")
    seen: list[object] = []
    monkeypatch.setattr(
        importlib.import_module(f"skipgs_plug.commands.{command}"), "run", lambda args: seen.append(args) or 0
    )
    known = text_options(options.Args)
    assert known
    positional = [f"~/{name}" for name, argument in known if not argument]
    for name, argument in known:
        spellings = [[argument, f"~/{name}"], [f"{argument}=~/{name}"]] if argument else [[]]
        for spelling in spellings:
            needed = ["--out", "~/x"] if command == "train" and name != "out" else []
            assert main([command, *positional, *needed, *spelling]) == 0
            assert values_of(seen[-1], name) == [f"/home/somebody/{name}"], (name, spelling)


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "doctor"])
def test_an_empty_argument_is_refused(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A shell variable that is not set leaves one. pathlib takes the current folder for it."""
    known = text_options(importlib.import_module(f"skipgs_plug.commands.options.{command}").Args)
    positional = [name for name, argument in known if not argument]
    for name, argument in known:
        spellings = [[*positional, argument, ""], [*positional, f"{argument}="]]
        for words in spellings if argument else [["" if word == name else word for word in positional]]:
            assert main([command, *words]) == 2
            named = argument or f"Argument {words.index('') + 1}"
            assert f"skipgs-plug: {named} is empty; give" in capsys.readouterr().err


def test_the_script_of_another_project_gets_its_arguments_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(importlib.import_module("skipgs_plug.commands.run"), "run", lambda args: seen.append(args) or 0)
    assert main(["run", "auto", "--", "~/train.py", "-s", "~/data"]) == 0
    assert seen[0].command == ("~/train.py", "-s", "~/data")


def test_a_run_folder_is_found_by_its_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    write_colmap(tmp_path / "scene")
    assert main(["train", "~/scene", "--out=~/run", *SHORT]) == 0
    assert main(["export", "~/run", "~/model.ply"]) == 0
    assert main(["report", "~/run", "--out", "~/page.html"]) == 0
    shutil.rmtree(tmp_path / "run/ckpts")
    assert main(["train", "~/scene", "--out", "~/again", "--init-ply=~/model.ply", *SHORT]) == 0
    assert (tmp_path / "page.html").is_file()
    assert (tmp_path / "again/cfg.yml").is_file()
    assert not Path("~").exists()
