"""Imports between parts, read from the source: a part imports only lower ones, and modules form no circle."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import skipgs_plug

ROOT = Path(skipgs_plug.__path__[0])
# Parts that each part may import, besides itself and modules that import nothing of the package.
MAY_IMPORT = {
    "core": set(),
    "adapters": {"core"},
    "gate": {"core", "adapters"},
    "scripts": {"core", "adapters", "gate"},
    "fallback_raster": set(),
    "compat": {"fallback_raster"},
    "trainer": {"fallback_raster", "compat"},
}


def imports() -> dict[str, set[str]]:
    """Modules of the package that each of them imports, in functions and for types too."""
    files = {}
    for path in ROOT.rglob("*.py"):
        name = ".".join(("skipgs_plug", *path.relative_to(ROOT).with_suffix("").parts))
        files[name.removesuffix(".__init__")] = path
    found = {}
    for name, path in files.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        wanted = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                wanted |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
                base = ".".join([*above, *([node.module] if node.module else [])])
                wanted |= {f"{base}.{alias.name}" if f"{base}.{alias.name}" in files else base for alias in node.names}
        found[name] = (wanted & set(files)) - {name}
    return found


IMPORTS = imports()


def part(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


@pytest.mark.parametrize("name", MAY_IMPORT)
def test_a_part_knows_only_those_below_it(name: str) -> None:
    own = {module for module in IMPORTS if part(module) == name}
    assert own
    others = {wanted for module in own for wanted in IMPORTS[module] if part(wanted) != name and IMPORTS[wanted]}
    assert {part(wanted) for wanted in others} <= MAY_IMPORT[name]


def test_reading_source_code_knows_nothing_of_the_pace() -> None:
    own = {module for module in IMPORTS if module.startswith("skipgs_plug.core.source.")}
    assert own
    assert not {wanted for module in own for wanted in IMPORTS[module] if wanted.startswith("skipgs_plug.core.pace")}


def reachable(module: str) -> set[str]:
    seen: set[str] = set()
    waiting = [module]
    while waiting:
        new = IMPORTS[waiting.pop()] - seen
        seen |= new
        waiting += new
    return seen


def test_no_two_modules_import_each_other() -> None:
    circles = {module for module in IMPORTS if module in reachable(module)}
    assert circles == set()


def test_every_module_that_is_imported_exists() -> None:
    """A module that was moved is found here: mypy takes one that it cannot find for another package's."""
    named = set()
    for folder in (ROOT, ROOT.parent / "tests", ROOT.parent / "benchmarks"):
        for path in folder.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ImportFrom) and not node.level and node.module:
                    named |= {node.module} if node.module.split(".")[0] == "skipgs_plug" else set()
    assert named
    assert named - set(IMPORTS) == set()


def test_only_the_rasterizer_and_its_stand_ins_know_its_inside() -> None:
    inside = "skipgs_plug.fallback_raster."
    reached = {(module, wanted) for module in IMPORTS for wanted in IMPORTS[module] if wanted.startswith(inside)}
    assert {part(module) for module, _ in reached} == {"fallback_raster", "compat"}


def test_the_training_loop_does_not_know_which_rasterizer_it_runs_on() -> None:
    assert not {wanted for wanted in IMPORTS["skipgs_plug.trainer.loop"] if part(wanted) == "fallback_raster"}
