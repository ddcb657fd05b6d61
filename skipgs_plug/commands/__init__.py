"""One file per command, each with `run(args) -> exit code`, imported only when called; `options`: their arguments."""
