"""Which functions belong to the user's project."""

import os
import posixpath

from skipgs_plug.core.source.project import Project


def test_frozen_functions_of_python_do_not_lie_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # as users run their scripts
    (tmp_path / "helpers.py").touch()
    names: dict = {"__name__": "__main__"}
    exec(compile("def own(): ...\n", str(tmp_path / "helpers.py"), "exec"), names)
    exec(compile("def of_cell(): ...\n", "<ipython-input-1>", "exec"), names)
    project = Project(compile("", str(tmp_path / "train.py"), "exec"), names)
    assert names["own"] in project and names["of_cell"] in project
    # Python 3.11 and newer holds these modules itself, and gives them no file.
    assert not any(one in project for one in (posixpath.join, os.makedirs, os.path.exists))
