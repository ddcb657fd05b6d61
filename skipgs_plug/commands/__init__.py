"""One file per command, each with `main(argv) -> exit code`; imported only when called."""
