"""The command `skipgs-plug`: a table of commands, each imported when it is called."""

from __future__ import annotations

import importlib
import sys
import traceback
from collections.abc import Sequence

COMMANDS = {
    "sfm": "turn photographs or a video into a scene",
    "demo": "train a scene the package makes itself, with and without the gate, and compare",
    "train": "train a COLMAP, Blender or packed scene, gated",
    "run": "run an unmodified training script of another project, gated",
    "bench": "compare the gate with its controls on a scene",
    "view": "show a trained model in the browser, with its cameras, photographs and errors",
    "render": "film or picture a trained model: colour and depth, along a path or from held-out cameras",
    "export": "convert a trained model for web viewers",
    "report": "make one HTML page of finished runs: tables, plots, comparison",
    "doctor": "say which backends and extras work here, and how to get the rest",
}
BAD_INPUT = 2
INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 done; 2 bad input, one sentence on stderr; 130 interrupted. `--debug` shows the traceback.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    own = arguments[: arguments.index("--")] if "--" in arguments else arguments
    debug = "--debug" in own
    if debug:
        arguments.remove("--debug")
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0 if arguments else BAD_INPUT
    command, *rest = arguments
    if command == "--version":
        from importlib.metadata import version

        print(version("skipgs_plug"))
        return 0
    if command not in COMMANDS:
        return fail(f"There is no command {command!r}; the commands are {', '.join(COMMANDS)}.")
    try:
        return importlib.import_module(f"skipgs_plug.commands.{command}").main(rest)
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as error:
        sentence = explain(error)
        if debug or sentence is None:
            traceback.print_exc()
            return BAD_INPUT if sentence else 1
        return fail(sentence)


def explain(error: Exception) -> str | None:
    """Return the sentence for the user, or None for a defect of ours, which deserves its traceback."""
    from skipgs_plug.core.errors import SkipGSError
    from skipgs_plug.trainer.errors import InputError

    if isinstance(error, (SkipGSError, InputError)):
        return str(error)
    if isinstance(error, ModuleNotFoundError) and not (error.name or "").startswith("skipgs_plug"):
        return f"This command needs the package {error.name}; run: pip install 'skipgs_plug[full]'."
    if isinstance(error, (PermissionError, IsADirectoryError, NotADirectoryError, FileExistsError)):
        return f"{error.filename}: {error.strerror}; give another path."
    return None


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
