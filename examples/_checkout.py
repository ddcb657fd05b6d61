"""Shared code of the train_*.py examples, which call `skipgs-plug run ADAPTER ... -- SCRIPT ...` from Python."""

from __future__ import annotations

import argparse
import inspect
import sys
from pathlib import Path

from skipgs_plug.cli import main


def run_in_checkout(adapter: str, *scripts: str) -> int:
    """Run a script of the checkout `--repo`, gated by this adapter, and return its exit code."""
    parser = _parser()
    parser.add_argument("--repo", type=Path, required=True, help="folder of the unmodified checkout")
    if len(scripts) > 1:
        parser.add_argument("--script", choices=scripts, default=scripts[0], help="which of its scripts to run")
    before, after = _split()
    args, gate_options = parser.parse_known_args(before)
    script = args.repo / (args.script if len(scripts) > 1 else scripts[0])
    return main(["run", adapter, *gate_options, "--", str(script), *after])


def run_module(adapter: str, module: str) -> int:
    """Run an installed module like `python -m`, gated by this adapter, and return its exit code."""
    before, after = _split()
    _, gate_options = _parser().parse_known_args(before)
    return main(["run", adapter, *gate_options, "--", "-m", module, *after])


def _split() -> tuple[list[str], list[str]]:
    """Return the example's and the script's part of the command line."""
    words = sys.argv[1:]
    at = words.index("--") if "--" in words else len(words)
    return words[:at], words[at + 1 :]


def _parser() -> argparse.ArgumentParser:
    """Return a parser that shows the docstring of the example as its help."""
    example = inspect.stack()[2].frame.f_globals["__doc__"]
    return argparse.ArgumentParser(
        description=example, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
