"""Fixtures for `skipgs-plug run` on a look-alike of Inria's checkout."""

import pytest
from inria_checkout import forget, write_checkout

from skipgs_plug import cli


@pytest.fixture
def checkout(tmp_path):
    """Path of the look-alike's train.py; forgets its modules afterwards."""
    yield str(write_checkout(tmp_path / "checkout"))
    forget()


@pytest.fixture
def train(checkout, tmp_path):
    """Run the look-alike gated: its output folder, options for it, options of the gate; give exit code and folder."""

    def run(name, *options, gate=()):
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        warmup = [] if {"--share", "--refine-share"} & {*gate} else ["--warmup", "10"]
        code = cli.main(["run", "inria", "--cpu", *warmup, *gate, "--", checkout, str(folder), *options])
        forget()
        return code, folder

    return run
