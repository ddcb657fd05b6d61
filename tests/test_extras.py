"""Each command imports with the packages of its extra alone, and names the extra of a missing package."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from skipgs_plug import cli
from skipgs_plug.install import install_command, program

tomllib = pytest.importorskip("tomllib")  # Python 3.11

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
MODULES = {"warp-lang": "warp", "pillow": "PIL", "pyyaml": "yaml", "imageio": "imageio", "jinja2": "jinja2"}
# Packages that come with torch and numpy, which may import them.
HIDE = """
import importlib.abc, sys
class Hidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {hidden!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Hidden())
"""


def extras() -> dict[str, set[str]]:
    """Return the import names that each extra brings, those of the extras it names included."""
    declared = tomllib.loads(PROJECT.read_text())["project"]["optional-dependencies"]

    def names(extra: str) -> set[str]:
        found: set[str] = set()
        for requirement in declared[extra]:
            nested = re.fullmatch(r"skipgs_plug\[(.*)\]", requirement)
            if nested:
                found |= set().union(*(names(name) for name in nested[1].split(",")))
            else:
                name = re.match(r"[\w-]+", requirement)[0]  # type: ignore[index]
                found.add(MODULES.get(name, name))
        return found

    return {extra: names(extra) for extra in declared if extra not in ("test", "docs")}


def run_without(hidden: set[str], code: str) -> subprocess.CompletedProcess[str]:
    script = HIDE.format(hidden=hidden) + code
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)


def test_full_is_everything() -> None:
    brought = extras()
    assert brought["full"] == set().union(*brought.values())


def test_a_plain_install_gates_and_looks_around() -> None:
    code = "import skipgs_plug.adapters, skipgs_plug.commands.doctor\nskipgs_plug.SkipGate(start_iter=3)"
    ended = run_without(extras()["full"], code)
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize("extra", ["run", "train", "report", "view"])
def test_commands_import_with_their_extra(extra: str) -> None:
    brought = extras()
    commands = [name for name, command in cli.COMMANDS.items() if command.extra == extra]
    assert commands
    code = f"""
from skipgs_plug.cli import main
for name in {commands!r}:
    try:
        failed = main([name, "--help"])
    except SystemExit as ended:  # tyro's way to end a help text
        failed = ended.code
    assert not failed, name
"""
    ended = run_without(brought["full"] - brought[extra], code)
    assert ended.returncode == 0 and ended.stdout.count("usage: skipgs-plug") == len(commands), ended.stderr


def test_a_missing_package_is_named_with_the_extra_that_brings_it() -> None:
    code = "import sys\nfrom skipgs_plug.cli import main\nsys.exit(main(['view', 'run']))"
    ended = run_without({"tyro"}, code)
    assert ended.returncode == 2
    assert f"needs the package tyro; run: {install_command('view')}" in ended.stderr


def test_commands_to_go_on_with_work_without_the_script_on_the_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda name: f"/bin/{name}")
    assert program() == "skipgs-plug"
    monkeypatch.setattr("shutil.which", lambda name: None)
    command = f"{program()} --help"
    ended = subprocess.run(command, shell=True, cwd=PROJECT.parent, capture_output=True, text=True, check=False)
    assert ended.returncode == 0 and "skipgs-plug" in ended.stdout
