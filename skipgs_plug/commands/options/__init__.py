"""Options of each command, as dataclasses. None of these modules imports torch, so `--help` answers at once."""
