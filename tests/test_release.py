"""The release has one version everywhere, accounts for every file, and has a licence for all code of others."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Kinds of files in the package. Code of others, such as a library for a page, comes minified or compiled, and needs a
# licence beside it that `license-files` names.
OWN = {".py", ".h", ".jinja", ".css", ".js", ".html", ".json", ".typed"}
LONGEST_LINE = 500  # characters; minified scripts have longer lines


def tracked(*folders: str) -> list[str]:
    ended = subprocess.run(["git", "ls-files", *folders], cwd=ROOT, capture_output=True, text=True, check=False)
    if ended.returncode or not ended.stdout:
        pytest.skip("not a checkout")
    return ended.stdout.split("\n")[:-1]


def test_one_version_everywhere() -> None:
    texts = {name: (ROOT / name).read_text("utf-8") for name in ("pyproject.toml", "CITATION.cff", "CHANGELOG.md")}
    project = re.search(r'^version = "(.*)"$', texts["pyproject.toml"], re.MULTILINE)
    cited = re.search(r"^version: (.*)$", texts["CITATION.cff"], re.MULTILINE)
    headings = re.findall(r"^## \[(.*?)\]", texts["CHANGELOG.md"], re.MULTILINE)
    assert project and cited and project[1] == cited[1]
    # An unreleased section may stand above the released version.
    assert next(heading for heading in headings if heading != "Unreleased") == project[1]


def test_everything_in_the_package_is_ours_or_comes_with_its_licence() -> None:
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    named = re.search(r"^license-files = \[(.*)\]$", project, re.MULTILINE)
    assert named
    licences = [ROOT / path for path in re.findall(r'"(.*?)"', named[1])]
    assert all(path.is_file() for path in licences)
    foreign = [name for name in tracked("skipgs_plug") if is_foreign(ROOT / name)]
    beside = {path.parent for path in licences}
    missing = [name for name in foreign if (ROOT / name).parent not in beside]
    assert not missing, f"no licence in license-files lies beside {missing}"


def test_the_licence_of_the_package_names_that_of_the_code_of_others() -> None:
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    expression = re.search(r'^license = "(.*?)"', project, re.MULTILINE)
    assert expression and expression[1].split(" AND ") == ["Apache-2.0", "MIT"]
    assert (ROOT / "skipgs_plug/view/web/supersplat/LICENSE").read_text("utf-8").startswith("MIT License")


def is_foreign(path: Path) -> bool:
    if path.suffix not in OWN:
        return True
    return (
        path.suffix in {".js", ".css"} and max(map(len, path.read_text("utf-8").splitlines()), default=0) > LONGEST_LINE
    )


def test_foreign_files_are_seen(tmp_path: Path) -> None:
    (tmp_path / "viewer.js").write_text("x=1;" * 200)
    (tmp_path / "page.css").write_text("p { margin: 0 }\n" * 200)
    assert is_foreign(tmp_path / "viewer.js") and is_foreign(tmp_path / "viewer.wasm")
    assert not is_foreign(tmp_path / "page.css")


def test_files_of_the_package_that_are_no_modules_are_declared_to_be_shipped() -> None:
    project = (ROOT / "pyproject.toml").read_text("utf-8")
    shipped = re.search(r"^skipgs_plug = \[(.*?)\]", project, re.MULTILINE | re.DOTALL)
    assert shipped
    patterns = re.findall(r'"(.*?)"', shipped[1])
    data = [name.removeprefix("skipgs_plug/") for name in tracked("skipgs_plug") if not name.endswith(".py")]
    assert data
    left = [name for name in data if not any(Path(name).match(pattern) for pattern in patterns)]
    assert not left, f"[tool.setuptools.package-data] does not name {left}"
