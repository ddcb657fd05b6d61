"""The command `skipgs-plug`: a table of commands. A command is imported when its options have been read."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import importlib
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, NamedTuple, Union

from skipgs_plug.garbage import keep_everything, uncollected
from skipgs_plug.messages import plain_warnings, say
from skipgs_plug.output import drop_what_does_not_fit, flush, print_any_name, replace_closed_streams
from skipgs_plug.terminate import UNREAD, Terminated, terminable


class Command(NamedTuple):
    """The purpose of a command, and the extra that installs its imports."""

    meaning: str
    extra: str


COMMANDS = {
    "sfm": Command("turn photographs or a video into a scene", "train"),
    "train": Command("train a scene by the 3DGS recipe, with --share in fewer iterations", "train"),
    "estimate": Command("predict how long training a scene takes here, from half a minute of training", "train"),
    "view": Command("show a trained model in the browser, with its cameras, photographs and errors", "view"),
    "render": Command("make a film or pictures of a trained model, along a path or from held-out cameras", "view"),
    "export": Command("convert a trained model for web viewers", "train"),
    "report": Command("make one HTML page of finished runs: tables, plots, comparison", "report"),
    "run": Command("run an unmodified training script of another project, gated", "run"),
    "demo": Command("train a small ray-traced scene with and without the gate, and compare", "full"),
    "bench": Command("compare the gate with its controls on a scene", "full"),
    "doctor": Command("say which backends and extras work here, and how to get the rest", "full"),
}
DESCRIPTION = "skipgs-plug COMMAND --help describes its options; --debug shows the traceback of an error."
# Exit codes: 2 as argparse uses it, and 128 plus the number of the signal, as shells count.
BAD_INPUT, INTERRUPTED, TERMINATED = 2, 130, 143
# Classes of errors whose message is all that a user needs. They are known by name, so that torch need not be loaded.
OURS = ("SkipGSError", "InputError", "WriteError")
WARNINGS = "GateWarning"  # class of the gate's warnings, likewise


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Standard streams that are closed are replaced by the null device, also after it has returned.

    Returns:
        0: done. 2: bad input, with one sentence on stderr, or with the traceback under `--debug`; or output that was
        dropped, because its disk is full. 130: interrupted. 143: terminated. 141: nobody reads the output.
    """
    if argv is None and sys.argv[1:2] != ["run"]:  # a script of another project runs as without this package
        speak_utf8()
    replace_closed_streams()
    print_any_name()
    arguments = list(sys.argv[1:] if argv is None else argv)
    # A script of another project keeps the garbage collector and the streams as they are, and so does a caller in
    # Python.
    if argv is not None or arguments[:1] == ["run"]:
        return answer(arguments, whole_program=False)
    outputs = drop_what_does_not_fit()
    try:
        code = answer(arguments, whole_program=True)
    except SystemExit as ended:  # tyro, after --help or a mistake
        code = int(ended.code or 0)
    lost = next((output.lost for output in outputs if output.lost), None)
    if lost and not code:
        return fail(f"Part of the output could not be written ({lost}), but all else is done; send it elsewhere.")
    return code


def answer(arguments: list[str], whole_program: bool) -> int:
    """Run one command, and turn an error into a sentence and an exit code."""
    own = arguments[: arguments.index("--")] if "--" in arguments else arguments
    own = [expand_home(argument) for argument in own]
    arguments[: len(own)] = own
    debug = "--debug" in own
    if debug:
        arguments.remove("--debug")
    try:
        # A script of another project gets signals as without this package.
        with contextlib.nullcontext() if arguments[:1] == ["run"] else terminable(), plain_warnings(WARNINGS):
            code = run(arguments, whole_program)
            if whole_program:
                flush()
            return code
    except KeyboardInterrupt as error:
        return interrupted([error])
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter flushes the stream once more
        return UNREAD
    except Exception as error:
        causes = [one for one in chain(error) if isinstance(one, KeyboardInterrupt)]
        if causes:  # it arrived while a module was imported
            return interrupted(causes)
        sentence = explain(error, COMMANDS[arguments[0]].extra if arguments and arguments[0] in COMMANDS else "run")
        if debug or sentence is None:
            traceback.print_exc()
            return BAD_INPUT if sentence else 1
        return fail(sentence)
    finally:
        if whole_program:
            keep_everything()


def speak_utf8() -> None:
    """Restart in UTF-8 mode if the locale has another encoding for file names.

    Scenes and run folders name files in UTF-8, so a photograph called `Straße.jpg` could not be opened. The new program
    gets the same bytes as arguments.
    """
    if sys.getfilesystemencoding() != "utf-8":
        os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])


def expand_home(argument: str) -> str:
    """Return an argument with `~` replaced by the home folder, as shells do not in `--out=~/runs`, quotes and lists."""
    option, equals, value = argument.partition("=") if argument.startswith("--") else ("", "", argument)
    return f"{option}{equals}{os.path.expanduser(value)}" if value.startswith("~") else argument


def run(arguments: list[str], whole_program: bool) -> int:
    """Find the command and call it, or list the commands."""
    name, *rest = arguments or [""]
    if name == "--version":
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(version("skipgs_plug"))
        except PackageNotFoundError:
            print("not installed: run from a checkout")
        return 0
    if name in COMMANDS:
        # Options are read before heavy packages are imported, so --help and mistakes are answered at once.
        args = importlib.import_module(f"skipgs_plug.commands.options.{name}").parse(rest)
        try:
            os.getcwd()
        except FileNotFoundError:  # MKL, which torch loads, would end the process
            return fail("The current folder has been removed; change to another one.")
        with uncollected() if whole_program else contextlib.nullcontext():
            command = importlib.import_module(f"skipgs_plug.commands.{name}")
            if whole_program:
                keep_everything()
        return command.run(args)
    if name and not name.startswith("-"):
        return fail(f"There is no command {name!r}; the commands are {', '.join(COMMANDS)}.")
    return overview(arguments) if arguments else overview(["--help"]) or BAD_INPUT


def overview(arguments: list[str]) -> int:
    """Answer --help and requests for shell completion.

    `--tyro-print-completion bash` (or zsh, tcsh) needs the options of all commands.
    """
    import tyro

    complete = any(argument.startswith("--tyro-") for argument in arguments)
    options: list[Any] = []
    for name, command in COMMANDS.items():
        module = importlib.import_module(f"skipgs_plug.commands.options.{name}") if complete else None
        kind = getattr(module, "Args", None) or dataclasses.make_dataclass(name, ())
        options.append(Annotated[kind, tyro.conf.subcommand(name, description=command.meaning)])
    commands: Any = Union[tuple(options)]  # noqa: UP007 - made at run time
    try:
        tyro.cli(commands, args=arguments, prog="skipgs-plug", description=DESCRIPTION)
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def explain(error: Exception, extra: str) -> str | None:
    """Return the sentence for the user, or None for a defect of this package, which needs its traceback.

    `extra` is the extra that installs the packages of the command.

    This imports no module that may be missing, or that a Ctrl-C may have left half loaded.
    """
    if any(one.__name__ in OURS and one.__module__.startswith("skipgs_plug.") for one in type(error).__mro__):
        # A file of the user that may not be read is neither damaged nor gone.
        denied = next((cause for cause in chain(error.__cause__) if isinstance(cause, PermissionError)), None)
        if denied is None or isinstance(error, OSError):
            return str(error)
        error = denied
    if isinstance(error, ImportError):
        while isinstance(error.__cause__, ImportError):  # the import itself: the error after it is for users of Python
            error = error.__cause__
        package = failed_package(error)
        if not package.startswith("skipgs_plug"):
            from skipgs_plug.install import install_command

            reason = str(error).partition("\n")[0]
            why = "" if isinstance(error, ModuleNotFoundError) else f", which cannot be imported ({reason})"
            return f"This command needs the package {package}{why}; run: {install_command(extra)}"
    if isinstance(error, OSError) and error.errno and error.strerror:
        from skipgs_plug.files import OUT_OF_SPACE

        # Of two files the second is the one that is written: a copy, or the new name.
        where = next((name for name in (error.filename2, error.filename) if name is not None), "A file")
        cure = "make room there or " if error.errno in OUT_OF_SPACE else ""
        if error.errno in (errno.EACCES, errno.EPERM):
            cure = "change its permissions or "
        return f"{where}: {error.strerror}; {cure}give another path."
    if is_out_of_memory(error):
        cause = str(error).partition("\n")[0]
        return f"There is not enough memory ({cause}); give smaller numbers, or a larger --data-factor."
    return None


def failed_package(error: ImportError) -> str:
    """Return the module that could not be imported, or the one whose code raised the error if the error names none."""
    if error.name:
        return error.name
    raised = error.__traceback__
    while raised is not None and raised.tb_next is not None:
        raised = raised.tb_next
    return str(raised.tb_frame.f_globals["__name__"]) if raised is not None else ""


def is_out_of_memory(error: Exception) -> bool:
    """Whether Python, NumPy, or torch on the CPU or a GPU could not allocate memory."""
    names = {one.__name__ for one in type(error).__mro__}
    return bool(names & {"MemoryError", "OutOfMemoryError"}) or "DefaultCPUAllocator" in str(error)


def chain(error: BaseException | None) -> Iterator[BaseException]:
    """Yield an error and its causes."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def interrupted(causes: Sequence[BaseException]) -> int:
    terminated = any(isinstance(cause, Terminated) for cause in causes)
    say("terminated." if terminated else "interrupted.")
    return TERMINATED if terminated else INTERRUPTED


def fail(sentence: str) -> int:
    say(sentence)
    return BAD_INPUT
