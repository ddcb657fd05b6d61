"""A fork that is read from a file, for tests of several kinds of forks."""

import pytest
from unknown_fork import unknown_fork


@pytest.fixture
def from_file(tmp_path):
    """Make the training module from a file, whose conditions can be read."""

    def make(**parts):
        return unknown_fork(**parts, file=tmp_path / "train.py")

    return make
