"""The command `skipgs-plug`: a table of commands, each imported when it is called."""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from collections.abc import Iterator, Sequence

COMMANDS = {
    "demo": "train a scene the package makes itself, with and without the gate, and compare",
    "train": "train a COLMAP, Blender or packed scene, gated",
    "run": "run an unmodified training script of another project, gated",
    "bench": "compare the gate with its controls on a scene",
    "report": "make one HTML page of finished runs: tables, plots, comparison",
    "doctor": "say which backends and extras work here, and how to get the rest",
}
BAD_INPUT = 2
INTERRUPTED = 130
UNREAD = 141
OURS = ("SkipGSError", "InputError", "WriteError")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 done; 2 bad input, one sentence on stderr; 130 interrupted, 143 terminated, 141 nobody reads the output.
        `--debug` shows the traceback.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    own = arguments[: arguments.index("--")] if "--" in arguments else arguments
    debug = "--debug" in own
    if debug:
        arguments.remove("--debug")
    try:
        return run(arguments)
    except KeyboardInterrupt:
        return interrupted()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter flushes once more
        return UNREAD
    except Exception as error:
        if any(isinstance(one, KeyboardInterrupt) for one in chain(error)):  # met while a module was being loaded
            return interrupted()
        sentence = explain(error)
        if debug or sentence is None:
            traceback.print_exc()
            return BAD_INPUT if sentence else 1
        return fail(sentence)


def run(arguments: list[str]) -> int:
    """Find the command and call it, or say what there is."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0 if arguments else BAD_INPUT
    command, *rest = arguments
    if command == "--version":
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(version("skipgs_plug"))
        except PackageNotFoundError:
            print("not installed: run from a checkout")
        return 0
    if command not in COMMANDS:
        return fail(f"There is no command {command!r}; the commands are {', '.join(COMMANDS)}.")
    return importlib.import_module(f"skipgs_plug.commands.{command}").main(rest)


def explain(error: Exception) -> str | None:
    """Return the sentence for the user, or None for a defect of ours, which deserves its traceback.

    Imports nothing that may be missing, or that a Ctrl-C may have left half loaded.
    """
    if any(one.__name__ in OURS and one.__module__.startswith("skipgs_plug.") for one in type(error).__mro__):
        return str(error)
    if isinstance(error, ModuleNotFoundError) and not (error.name or "").startswith("skipgs_plug"):
        from skipgs_plug.install import install_command

        return f"This command needs the package {error.name}; run: {install_command()}"
    if isinstance(error, OSError) and error.errno and error.strerror:
        where = error.filename if error.filename is not None else "A file"
        return f"{where}: {error.strerror}; make room there or give another path."
    return None


def chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error, and those that it arose from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def interrupted() -> int:
    print("skipgs-plug: interrupted.", file=sys.stderr)
    return INTERRUPTED


def fail(sentence: str) -> int:
    print(f"skipgs-plug: {sentence}", file=sys.stderr)
    return BAD_INPUT


def usage() -> str:
    rows = "\n".join(f"  {name:8} {meaning}" for name, meaning in COMMANDS.items())
    return (
        f"usage: skipgs-plug COMMAND ... [--debug]\n\n{rows}\n\n"
        "skipgs-plug COMMAND --help describes its options; --debug shows the traceback of an error."
    )


if __name__ == "__main__":
    sys.exit(main())
