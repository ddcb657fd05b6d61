"""A script is run as Python would run it, and its exit code comes back."""

import sys

import numpy as np
import pytest
import torch

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.scripts.import_hints import install_hint
from skipgs_plug.scripts.launch import run_script, source_of


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A folder with a script and the neighbour it imports; forgets the neighbour afterwards."""
    folder = tmp_path / "checkout"
    (folder / "neighbour_of_script").mkdir(parents=True)
    (folder / "neighbour_of_script" / "__init__.py").write_text("VALUE = 'own'\n")
    yield folder
    for name in ("neighbour_of_script", "neighbour_of_script.train"):
        sys.modules.pop(name, None)


def write(checkout, body):
    script = checkout / "train.py"
    script.write_text(body)
    return str(script)


def test_script_sees_its_own_folder_arguments_and_name(checkout, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    script = write(
        checkout,
        "import os, sys\n"
        "from neighbour_of_script import VALUE\n"
        "if __name__ == '__main__':\n"
        "    print(VALUE, sys.argv[1:], os.getcwd(), os.path.basename(sys.argv[0]))\n",
    )
    before = (sys.argv, list(sys.path))
    assert run_script([script, "-s", "data"]) == 0
    assert capfd.readouterr().out == f"own ['-s', 'data'] {tmp_path} train.py\n"
    assert (sys.argv, sys.path) == before


def test_attach_can_reach_into_what_the_script_will_import(checkout, capfd):
    def attach():
        import neighbour_of_script

        neighbour_of_script.VALUE = "patched"

    script = write(checkout, "from neighbour_of_script import VALUE\nprint(VALUE)\n")
    assert run_script([script], attach) == 0
    assert capfd.readouterr().out == "patched\n"


@pytest.mark.parametrize(
    ("ending", "code"),
    [("sys.exit()", 0), ("sys.exit(3)", 3), ("sys.exit('no data')", 1), ("raise KeyboardInterrupt", 130)],
)
def test_exit_code_is_the_scripts(checkout, ending, code, capfd):
    assert run_script([write(checkout, f"import sys\n{ending}\n")]) == code
    assert ("no data" in capfd.readouterr().err) == ("no data" in ending)


def test_traceback_starts_in_the_script(checkout, capfd):
    script = write(checkout, "def training():\n    raise ValueError('broken scene')\ntraining()\n")
    assert run_script([script]) == 1
    error = capfd.readouterr().err
    assert "ValueError: broken scene" in error and "in training" in error
    assert "runpy" not in error and "launch.py" not in error


def test_an_error_goes_to_the_hook_that_the_script_has_set(checkout, monkeypatch, capfd):
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    hook = "sys.excepthook = lambda kind, error, trace: print(error, trace.tb_frame.f_globals['__name__'])"
    assert run_script([write(checkout, f"import sys\n{hook}\nraise ValueError('broken scene')\n")]) == 1
    captured = capfd.readouterr()
    assert captured.out == "broken scene __main__\n" and captured.err == ""


def test_objects_of_the_scripts_classes_come_back_from_its_processes(checkout, capfd):
    script = write(
        checkout,
        "import multiprocessing\n"
        "from concurrent.futures import ProcessPoolExecutor\n"
        "class View:\n"
        "    number = 3\n"
        "if __name__ == '__main__':\n"
        "    with ProcessPoolExecutor(1, multiprocessing.get_context('spawn')) as pool:\n"
        "        print(type(pool.submit(View).result(timeout=60)) is View)\n",
    )
    before = sys.modules["__mp_main__"]
    assert run_script([script]) == 0
    assert capfd.readouterr().out == "True\n"
    assert sys.modules["__mp_main__"] is before


def test_our_own_errors_pass_through(checkout):
    script = write(checkout, "from skipgs_plug.core.errors import SkipGSError\nraise SkipGSError('wrong')\n")
    with pytest.raises(SkipGSError, match="wrong"):
        run_script([script])


def test_stdout_that_the_script_replaces_is_given_back(checkout):
    before = sys.stdout
    assert run_script([write(checkout, "import sys, io\nsys.stdout = io.StringIO()\n")]) == 0
    assert sys.stdout is before


def test_checkpoints_with_numpy_scalars_load(checkout, tmp_path):
    torch.save({"scale": np.float64(2.5)}, tmp_path / "a.pth")
    load = torch.load
    script = write(checkout, f"import torch\nassert torch.load({str(tmp_path / 'a.pth')!r})['scale'] == 2.5\n")
    assert run_script([script]) == 0
    assert torch.load is load


def test_a_module_is_run_as_python_does_with_m(checkout, monkeypatch, capfd):
    (checkout / "neighbour_of_script" / "train.py").write_text(
        "import sys\nfrom neighbour_of_script import VALUE\nprint(VALUE, __name__, sys.argv[1:])\n"
    )
    monkeypatch.chdir(checkout)  # the installed command has no current folder on its path
    assert run_script(["-m", "neighbour_of_script.train", "-i", "3"]) == 0
    assert capfd.readouterr().out == "own __main__ ['-i', '3']\n"


def test_a_module_that_asks_for_type_hints_of_its_own_classes_is_run(checkout, monkeypatch):
    (checkout / "neighbour_of_script" / "train.py").write_text(
        "from __future__ import annotations\nimport dataclasses, typing\nfrom pathlib import Path\n"
        "@dataclasses.dataclass\nclass Arguments:\n    folder: Path\n"
        "assert typing.get_type_hints(Arguments) == {'folder': Path}\n"
    )
    monkeypatch.chdir(checkout)
    before = sys.modules["__main__"]
    assert run_script(["-m", "neighbour_of_script.train"]) == 0
    assert sys.modules["__main__"] is before


@pytest.fixture
def installed(checkout, monkeypatch):
    """A package on the path that brings the command `train-neighbour`."""
    facts = checkout / "neighbour_of_script-1.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: neighbour-of-script\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text("[console_scripts]\ntrain-neighbour = neighbour_of_script.train:entry\n")
    monkeypatch.syspath_prepend(checkout)
    return checkout / "neighbour_of_script" / "train.py"


def test_an_installed_command_is_run_by_its_name(installed, capfd):
    installed.write_text("import os, sys\ndef entry():\n    print(os.path.basename(sys.argv[0]), sys.argv[1:])\n")
    assert run_script(["train-neighbour", "-i", "3"]) == 0
    assert capfd.readouterr().out == "train-neighbour ['-i', '3']\n"


def test_an_installed_command_fails_as_itself(installed, capfd):
    installed.write_text("def entry():\n    raise ValueError('broken scene')\n")
    sys.modules.pop("neighbour_of_script.train", None)
    assert run_script(["train-neighbour"]) == 1
    error = capfd.readouterr().err
    assert "ValueError: broken scene" in error and "launch.py" not in error
    installed.write_text("def entry():\n    return 3\n")
    sys.modules.pop("neighbour_of_script.train", None)
    assert run_script(["train-neighbour"]) == 3


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ([], "no script to run"),
        (["-m"], "no script to run"),
        (["-m", "absent_module.train"], "no module absent_module"),
        (["python", "train.py"], "Leave out python: write after '--' what follows it"),
        (["/usr/bin/python3.11", "-u", "train.py"], "Leave out /usr/bin/python3.11: write"),
        (["bash", "run.sh"], "bash is not Python: write skipgs-plug run ADAPTER -- in place of python"),
        (["scripts/run.sh"], "scripts/run.sh is not Python"),
        (["torchrun", "--nproc_per_node", "2", "train.py"], "torchrun ... -m skipgs_plug run ADAPTER -- train.py"),
        (["-u", "train.py"], "-u is no script: .* those of Python follow python, as in python -u -m skipgs_plug run"),
        (["--cpu", "train.py"], "--cpu is no script: .* options of skipgs-plug go before '--'"),
        (["CUDA_VISIBLE_DEVICES=0", "python", "train.py"], "CUDA_VISIBLE_DEVICES=0 sets a variable .* before skipgs"),
        (["env", "train.py"], "env is a program, .* as in env ... skipgs-plug run ADAPTER -- train.py"),
    ],
)
def test_nothing_to_run_is_said(command, message):
    with pytest.raises(SkipGSError, match=message):
        run_script(command)


def test_a_command_of_another_python_is_named(tmp_path, monkeypatch):
    program = tmp_path / "train-elsewhere"
    program.write_text("#!/elsewhere/bin/python3\nimport trainer\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SkipGSError, match=f"{program} belongs to another Python .* install skipgs-plug there too"):
        run_script(["train-elsewhere", "--data", "garden"])


@pytest.mark.parametrize(
    ("beginning", "sentence"),
    [
        (f"#!{sys.executable}", "is a Python script on the PATH: give its path"),
        ("#!/usr/bin/env python3", "is a Python script on the PATH: give its path"),
        ("#!/bin/sh\n'''exec' '/elsewhere/long path/bin/python' \"$0\" \"$@\"", "belongs to another Python"),
        ("#!/bin/sh\nexec python train.py", "is a program, and no Python script"),
    ],
)
def test_what_runs_a_program_is_read_from_its_beginning(beginning, sentence, tmp_path, monkeypatch):
    (tmp_path / "train-it").write_text(f"{beginning}\nimport trainer\n")
    (tmp_path / "train-it").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SkipGSError, match=sentence):
        run_script(["train-it"])


def test_a_script_whose_path_looks_like_a_variable_runs(tmp_path, monkeypatch):
    (tmp_path / "lr=1").mkdir()
    (tmp_path / "lr=1/train.py").write_text("print('trained')")
    monkeypatch.chdir(tmp_path)
    assert source_of(["lr=1/train.py"]) == tmp_path / "lr=1/train.py"


def test_the_source_of_a_module_is_found_without_importing_its_packages(checkout, monkeypatch):
    package = checkout / "package_of_script" / "inner"
    package.mkdir(parents=True)
    for folder in (package, package.parent):
        (folder / "__init__.py").write_text("raise ImportError('libtorch_cuda.so')\n")
    (package / "train.py").write_text("pass\n")
    monkeypatch.syspath_prepend(checkout)
    assert source_of(["-m", "package_of_script.inner.train"]) == (package / "train.py").resolve()
    (package.parent / "__main__.py").write_text("pass\n")  # Python runs it for a package
    assert source_of(["-m", "package_of_script"]) == (package.parent / "__main__.py").resolve()


def test_missing_script_is_named(tmp_path):
    with pytest.raises(SkipGSError, match=r"no script .*absent\.py"):
        run_script([str(tmp_path / "absent.py")])
    with pytest.raises(SkipGSError, match="is a folder: name the training script in it"):
        run_script([str(tmp_path)])


def test_a_module_imported_from_elsewhere_is_refused(checkout, tmp_path, monkeypatch):
    other = tmp_path / "other"
    other.mkdir()
    (other / "neighbour_of_script.py").write_text("VALUE = 'foreign'\n")
    monkeypatch.syspath_prepend(other)
    __import__("neighbour_of_script")
    with pytest.raises(SkipGSError, match=r"'neighbour_of_script' was already imported .* one training"):
        run_script([write(checkout, "pass\n")])


def test_missing_module_is_named(checkout, capfd):
    assert run_script([write(checkout, "import absent_module_of_script.part\n")]) == 1
    error = capfd.readouterr().err
    assert "Traceback" in error and "train.py needs the module absent_module_of_script, which is not" in error
    assert "pip install" not in error  # a file may be missing whose name is another package's


@pytest.mark.parametrize(
    ("module", "listing", "text", "advice"),
    [
        ("absent_module", "requirements.txt", "numpy\nAbsent-Module>=2\n", "lists; run: pip install absent_module"),
        ("absent_module", "../environment.yml", "  - pip:\n    - absent_module\n", "environment.yml lists; run: pip"),
        (
            "absent_module",
            "environment.yml",
            "  - absent_module=1.0\n  - pip:\n    - numpy\n",
            "lists for conda: install",
        ),
        ("plyfile", "environment.yml", "  - plyfile=0.8.1\n", "environment.yml lists; run: pip install plyfile"),
        ("absent", "requirements.txt", "absent-module\n", "If absent is part of the checkout"),
        ("absent", "environment.yml", "name: absent\n  - numpy\n", "If absent is part of the checkout"),
        ("absent", "requirements.txt", "git+https://host/absent.git\n", "takes from git+https://host/absent.git:"),
        ("absent", "requirements.txt", "# absent\n", "If absent is part of the checkout"),
        ("absent", "pyproject.toml", 'name = "absent"\n', "If absent is part of the checkout"),
        ("absent", "setup.py", "setup(name='own', install_requires=['absent'])\n", "run: pip install absent"),
        (
            "pup_fisher",
            "environment.yml",
            "  - submodules/pup-fisher\n",
            "environment.yml takes from submodules/pup-fisher:",
        ),
        (
            "absent",
            "setup.cfg",
            "  absent @ git+https://host/of/it.git\n",
            "takes from absent @ git+https://host/of/it.git",
        ),
        ("absent", "requirements.txt", "# see https://host/absent\nabsent\n", "lists; run: pip install absent"),
        ("skimage", None, "", "run: pip install scikit-image"),
        (
            "skimage",
            "requirements.txt",
            "scikit-image\n",
            "which requirements.txt lists; run: pip install scikit-image",
        ),
    ],
)
def test_only_packages_are_said_to_be_installed(tmp_path, module, listing, text, advice):
    script = tmp_path / "checkout/train.py"
    script.parent.mkdir()
    if listing is not None:
        (script.parent / listing).write_text(text)
    assert advice in install_hint(module, script)


def test_error_while_attaching_is_the_scripts(checkout, capfd):
    (checkout / "neighbour_of_script" / "__init__.py").write_text("import simple_knn\n")
    script = write(checkout, "from neighbour_of_script import VALUE\n")
    assert run_script([script], lambda: __import__("neighbour_of_script")) == 1
    error = capfd.readouterr().err
    assert "neighbour_of_script/__init__.py" in error and "launch.py" not in error
    assert "simple_knn is a CUDA extension" in error


def test_the_cpu_is_advised_only_where_it_serves_the_module(checkout, capfd):
    script = write(checkout, "import diff_of_fork\n")
    for stand_ins in ((), ("diff_of_fork",)):
        assert run_script([script], stand_ins=stand_ins) == 1
        error = capfd.readouterr().err
        assert "Traceback" in error and ("--cpu before '--'" in error) == bool(stand_ins)
    assert run_script([script], on_cpu=True) == 1
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "no CPU stand-in: run the script on a GPU, without --cpu" in error
