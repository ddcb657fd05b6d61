"""What each command takes, as dataclasses; nothing here imports torch, so `--help` and typing errors answer at once."""
