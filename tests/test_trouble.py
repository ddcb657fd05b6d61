"""Packages that are missing, disks that are full, Ctrl-C that comes early: one sentence, never a traceback."""

from __future__ import annotations

import errno
import os
import shlex
import signal
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch

from skipgs_plug import cli, install
from skipgs_plug.files import WriteError, remove_leftovers, write_aside
from skipgs_plug.install import install_command
from skipgs_plug.trainer.errors import InputError

# A Python without the named packages, which then runs a command.
WITHOUT = """
import sys
missing = set(sys.argv[1].split(","))
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in missing:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name.partition(".")[0])
sys.meta_path.insert(0, Missing())
from skipgs_plug.cli import main
sys.exit(main(sys.argv[2:]))
"""
EXTRAS = "warp,gsplat,pycolmap,PIL,plyfile,scipy,tyro,tqdm,filelock,yaml,torchmetrics,matplotlib,tensorboard"


def without(packages: str, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", WITHOUT, packages, *command], capture_output=True, text=True, check=False, timeout=120
    )


def test_base_install_says_how_to_get_the_rest() -> None:
    tried = without(EXTRAS, "train", "--help")
    assert tried.returncode == 2 and "Traceback" not in tried.stderr
    assert tried.stderr.strip().splitlines() == [
        f"skipgs-plug: This command needs the package tyro; run: {install_command('train')}"
    ]


def test_doctor_works_without_extras() -> None:
    tried = without(EXTRAS, "doctor")
    # Backends are tried in other processes, from which no package is hidden.
    assert tried.returncode == 0 and tried.stderr == ""
    assert "tyro          missing, for: command line; run: pip install tyro" in tried.stdout
    assert f"Get all missing packages with: {install_command()}" in tried.stdout


def test_doctor_says_in_which_order_to_import() -> None:
    tried = without("matplotlib", "doctor")
    assert "import PIL.Image before pycolmap" in tried.stdout and tried.returncode == 0


def test_the_cure_is_the_checkout_that_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path / "a checkout"
    (root / "skipgs_plug").mkdir(parents=True)
    (root / "pyproject.toml").write_text('[project]\nname = "skipgs_plug"\n')
    monkeypatch.setattr(install, "__file__", str(root / "skipgs_plug/install.py"))
    assert shlex.split(install_command()) == ["pip", "install", "-e", f"{root}[full]"]


@pytest.mark.parametrize(
    ("origin", "requirement"),
    [
        (None, "skipgs_plug[full]"),
        ('{"url": "file:///nowhere/at/all"}', "skipgs_plug[full]"),
        (
            '{"url": "https://host/repo", "vcs_info": {"vcs": "git", "commit_id": "abc"}}',
            "skipgs_plug[full] @ git+https://host/repo@abc",
        ),
        ("damaged", "skipgs_plug[full]"),
    ],
)
def test_the_cure_is_where_the_package_came_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, origin: str | None, requirement: str
) -> None:
    class Installed:
        def read_text(self, name: str) -> str | None:
            assert name == "direct_url.json"
            return origin

    monkeypatch.setattr(install, "__file__", str(tmp_path / "skipgs_plug/install.py"))
    monkeypatch.setattr(metadata, "distribution", lambda name: Installed())
    assert shlex.split(install_command()) == ["pip", "install", requirement]


@pytest.mark.parametrize(("name", "code", "said"), [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")])
def test_a_signal_while_torch_is_being_imported(name: str, code: int, said: str) -> None:
    script = (
        "import sys, signal\n"
        "from skipgs_plug.cli import main\n"
        "assert 'torch' not in sys.modules\n"
        "class Interrupt:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'torch.nn': signal.raise_signal(signal.Signals[sys.argv[1]])\n"
        "sys.meta_path.insert(0, Interrupt())\n"
        "sys.exit(main(['train', 'scene', '--out', 'folder']))\n"
    )
    command = [sys.executable, "-c", script, name]
    tried = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert tried.returncode == code
    assert tried.stderr.strip() == f"skipgs-plug: {said}."


def test_ctrl_c_that_an_import_turned_into_another_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(name: str) -> None:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            for _ in range(10**6):
                pass
        except KeyboardInterrupt as error:
            raise ImportError("initialization failed") from error

    monkeypatch.setattr(cli.importlib, "import_module", broken)
    assert cli.main(["train"]) == 130


def failing(error: Exception) -> type:
    """Return the module of a command that ends with this error."""

    class Command:
        @staticmethod
        def parse(arguments: list[str]) -> None:
            return None

        @staticmethod
        def run(args: None) -> int:
            raise error

    return Command


@pytest.mark.parametrize(
    ("number", "cure"),
    [
        (errno.ENOSPC, "make room there or give another path"),
        (errno.EFBIG, "make room there or give another path"),
        (errno.EACCES, "change its permissions or give another path"),
        (errno.EROFS, "give another path"),
        (errno.ENAMETOOLONG, "give another path"),
        (errno.EIO, "give another path"),
    ],
)
def test_file_systems_in_trouble(
    number: int, cure: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = OSError(number, os.strerror(number), "/some/where")
    monkeypatch.setattr(cli.importlib, "import_module", lambda name: failing(error))
    assert cli.main(["report"]) == 2
    assert capsys.readouterr().err == (f"skipgs-plug: /some/where: {os.strerror(number)}; {cure}.\n")


def test_nobody_reads_the_output() -> None:
    code = "import sys; from skipgs_plug.cli import main; sys.exit(main(['--help']))"
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "wb") as output:
        tried = subprocess.run(
            [sys.executable, "-u", "-c", code], stdout=output, stderr=subprocess.PIPE, check=False, timeout=60
        )
    assert tried.returncode == 141 and tried.stderr == b""


CLOSED = """
import os, sys
from skipgs_plug.cli import main
main(["--version"])
numbers = [stream.fileno() for stream in (sys.stdin, sys.stdout, sys.stderr)]
print("lost"), print("lost", file=sys.stderr)
os.write(1, b"lost"), os.write(2, b"lost")  # as native code does
with open(sys.argv[1], "w") as file:
    file.write(f"{numbers} {file.fileno() > 2}")
"""


@pytest.mark.skipif(os.name == "nt", reason="closes streams by a POSIX shell")
@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", ">&-", "2>&-"])
def test_closed_standard_streams_get_no_file(closed: str, tmp_path: Path) -> None:
    command = shlex.join([sys.executable, "-c", CLOSED, str(tmp_path / "written")])
    tried = subprocess.run(f"exec {command} {closed}", shell=True, check=False, timeout=60, stdin=subprocess.DEVNULL)
    assert tried.returncode == 0 and (tmp_path / "written").read_text() == "[0, 1, 2] True"


@pytest.mark.skipif(os.name == "nt", reason="closes streams by a POSIX shell")
def test_kernels_run_where_standard_streams_are_closed() -> None:
    code = "import torch; from skipgs_plug.fallback_raster import l1_ssim_loss; i = torch.rand(20, 20, 3); "
    command = shlex.join([sys.executable, "-c", code + "assert l1_ssim_loss(i, i) < 1e-6"])
    tried = subprocess.run(f"exec {command} <&- >&- 2>&-", shell=True, check=False, timeout=120)
    assert tried.returncode == 0


@pytest.mark.skipif(os.name == "nt", reason="Windows keeps the current folder of a process")
def test_a_current_folder_that_was_removed_is_named(tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    python = shlex.join([sys.executable, "-m", "skipgs_plug", "train", str(tmp_path), "--out", str(tmp_path / "run")])
    code = f"cd {shlex.quote(str(tmp_path / 'gone'))} && rmdir ../gone && {python}"
    path = {"PYTHONPATH": str(Path(cli.__file__).parent.parent)}
    tried = subprocess.run(code, shell=True, capture_output=True, text=True, check=False, env={**os.environ, **path})
    assert tried.returncode == 2
    assert tried.stderr.endswith("skipgs-plug: The current folder has been removed; change to another one.\n")


def test_a_file_that_cannot_be_written_says_how_much_it_needs(tmp_path: Path) -> None:
    import resource

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))  # a write stops in the middle, as on a full disk
    try:
        with (
            pytest.raises(
                WriteError, match=r"x\.bin cannot be written \(File too large\): it needs about 0.1 MB, .* MB are"
            ),
            write_aside(tmp_path / "x.bin", size=100_000) as temporary,
        ):
            temporary.write_bytes(bytes(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_only_leftovers_are_removed(tmp_path: Path) -> None:
    for name in (".x.ply.4711.tmp", ".skipgs.json.4711", ".lock", ".owner.json", ".hidden", "x.4711.tmp"):
        (tmp_path / name).write_text("")
    remove_leftovers(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".hidden", ".lock", ".owner.json", "x.4711.tmp"]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_device_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")  # like /dev/null, which root could replace
    (tmp_path / "link").symlink_to("pipe")
    for name in ("pipe", "link"):
        with pytest.raises(WriteError, match="a device or a pipe"), write_aside(tmp_path / name) as temporary:
            temporary.write_text("new")
    assert (tmp_path / "pipe").is_fifo() and (tmp_path / "link").is_symlink()


def test_a_link_stays_and_its_file_is_written(tmp_path: Path) -> None:
    (tmp_path / "large disk").mkdir()
    (tmp_path / "link").symlink_to("large disk/model")
    with write_aside(tmp_path / "link") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "large disk/model").read_text() == "new"
    assert [path.name for path in (tmp_path / "large disk").iterdir()] == ["model"]


@pytest.mark.parametrize(
    ("target", "cure"),
    [
        ("file/x.html", "file is a file, not a folder; give another path."),
        ("file/deeper/x.html", "file is a file, not a folder; give another path."),
        ("folder", "folder is a folder; give the name of a file."),
        ("", " is a folder; give the name of a file."),
    ],
)
def test_what_is_in_the_way_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str, cure: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("kept")
    (tmp_path / "folder").mkdir()
    with pytest.raises(WriteError) as raised, write_aside(target) as temporary:
        temporary.write_text("new")
    assert str(raised.value).endswith(cure) and "make its folder writable" not in str(raised.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]
    assert (tmp_path / "file").read_text() == "kept"


def test_a_copy_that_does_not_fit_names_the_copy(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/photographs/a.jpg", None, "/scene/a.jpg")
    monkeypatch.setattr(cli.importlib, "import_module", lambda name: failing(error))
    assert cli.main(["sfm"]) == 2
    assert capsys.readouterr().err.startswith("skipgs-plug: /scene/a.jpg: No space left on device; make room there")


def test_a_file_that_may_not_be_read_is_not_called_damaged(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = InputError("transforms.json is not valid JSON; restore the file.")
    error.__cause__ = PermissionError(errno.EACCES, os.strerror(errno.EACCES), "/scene/transforms.json")
    monkeypatch.setattr(cli.importlib, "import_module", lambda name: failing(error))
    assert cli.main(["train"]) == 2
    assert capsys.readouterr().err == (
        "skipgs-plug: /scene/transforms.json: Permission denied; change its permissions or give another path.\n"
    )


def test_too_little_memory_is_one_sentence(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    too_large = 1 << 55
    for allocate in (bytes, np.empty, torch.empty):
        with pytest.raises((MemoryError, RuntimeError)) as raised:
            allocate(too_large)
        error = raised.value
        monkeypatch.setattr(cli.importlib, "import_module", lambda name, error=error: failing(error))
        assert cli.main(["train"]) == 2
        said = capsys.readouterr().err
        assert said.startswith("skipgs-plug: There is not enough memory (") and len(said.splitlines()) == 1
