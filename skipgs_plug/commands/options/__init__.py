"""Options of each command, as dataclasses. Nothing here imports torch, so `--help` and typing errors answer at once."""
