"""Checks of the folder names that a user gives."""

from __future__ import annotations

from skipgs_plug.trainer.errors import InputError


def require_names(*given: tuple[str, str]) -> None:
    """Raise InputError for the first (option, folder) whose name is empty: pathlib would use the current folder."""
    for option, name in given:
        if not name:
            raise InputError(f"{option} is empty; give the name of a folder.")
