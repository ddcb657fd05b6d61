"""Each file of the kernels can be read by itself: an editor resolves every name."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from skipgs_plug.fallback_raster.declarations import FLAGS, workers, write
from skipgs_plug.fallback_raster.runtime.native import _warp
from skipgs_plug.fallback_raster.runtime.source import KERNELS

FILES = sorted(path.relative_to(KERNELS).as_posix() for path in KERNELS.rglob("*.h"))


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Return the arguments of the compiler by file."""
    entries: list[dict[str, Any]] = json.loads(write(tmp_path_factory.mktemp("editor")).read_text())
    return {Path(entry["file"]).relative_to(KERNELS).as_posix(): entry["arguments"] for entry in entries}


def compile_alone(file: Path, arguments: list[str], folder: Path) -> None:
    """Compile a file with the Clang that Warp brings, which takes the same arguments as any other."""
    _warp()
    build = pytest.importorskip("warp._src.build")
    flags = arguments[arguments.index(FLAGS[0]) : arguments.index("-fsyntax-only")]
    build.build_cpu(str(folder / "out.o"), str(file), extra_flags=" ".join(flags))


@pytest.mark.parametrize("file", FILES)
def test_a_file_compiles_by_itself(file: str, database: dict[str, list[str]], tmp_path: Path) -> None:
    compile_alone(KERNELS / file, database[file], tmp_path)


def test_no_two_files_have_the_same_name() -> None:
    assert len({Path(file).name for file in FILES}) == len(FILES)


def test_a_name_that_nobody_declares_is_found(
    database: dict[str, list[str]], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken.h"
    broken.write_text(
        "#pragma once\nstatic constexpr auto broken = [](const Camera& camera) { return camera.widht; };\n"
    )
    with pytest.raises(Exception, match="build failed"):
        compile_alone(broken, database[FILES[0]], tmp_path)
    assert "no member named 'widht' in 'Camera'" in capfd.readouterr().err


def test_each_kernel_names_its_parameters_as_its_stub_does() -> None:
    for name, worker in workers().items():
        assert worker.file is not None, name
        text = (KERNELS / worker.file).read_text()
        function = worker.file.removesuffix(".h")
        signature = re.search(
            rf"^static constexpr auto {function} =\s*\[\]\((.*?)\) INLINE", text, re.DOTALL | re.MULTILINE
        )
        assert signature, name
        names = re.findall(r"(\w+)(?:,|$)", signature[1])
        assert names == [*worker.parameter_names, "first", "last"], name


def test_each_kernel_says_what_it_reads_and_who_else_writes() -> None:
    for worker in workers().values():
        assert worker.file is not None
        head = (KERNELS / worker.file).read_text().split("#pragma once")[0]
        contract = head.replace("\n// ", " ").split("//")[-1]
        assert re.search(r"\b(Reads|Writes)\b", contract), worker.file
        assert re.search(r"\b[Nn]o other thread\b|\bruns on one thread\b", contract), worker.file


def test_the_command_writes_where_it_is_told(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "skipgs_plug.fallback_raster.declarations", str(tmp_path / "editor")]
    written = subprocess.run(command, capture_output=True, text=True, check=True, cwd=KERNELS.parents[2])
    assert written.stdout == f"{tmp_path / 'editor' / 'compile_commands.json'}\n"
    assert (tmp_path / "editor" / "declarations.h").exists()
