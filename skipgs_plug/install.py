"""Commands printed for the user: to install optional packages, and to go on. They fit this installation."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import sys
from importlib import metadata
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import url2pathname

NAME = "skipgs_plug"
PROGRAM = "skipgs-plug"


def program() -> str:
    """Return the program name of this package, or the Python command for it if the name is not on the path."""
    return PROGRAM if shutil.which(PROGRAM) else f"{shlex.quote(sys.executable)} -m {NAME}"


def next_command(*words: str | Path) -> str:
    """Return a command line of this package, quoted so that it can be pasted into a shell."""
    return f"{program()} {shlex.join(map(str, words))}"


def install_command(extra: str = "full") -> str:
    """Return the `pip install` command for an extra of this package, from the source of the installed package."""
    root = Path(__file__).resolve().parents[1]
    if _is_checkout(root):
        return f"pip install -e {shlex.quote(f'{root}[{extra}]')}"
    source = _source()
    return f"pip install {shlex.quote(f'{NAME}[{extra}]' + (f' @ {source}' if source else ''))}"


def _is_checkout(root: Path) -> bool:
    try:
        return re.search(rf'^name = "{NAME}"$', (root / "pyproject.toml").read_text("utf-8"), re.MULTILINE) is not None
    except (OSError, UnicodeDecodeError):
        return False


def _source() -> str | None:
    """Return the source of the installed package; None if it came from an index (PEP 610)."""
    try:
        found = json.loads(metadata.distribution(NAME).read_text("direct_url.json") or "{}")
    except (metadata.PackageNotFoundError, ValueError):
        return None
    url = found.get("url")
    if url is None:
        return None
    if url.startswith("file:") and not Path(url2pathname(urlparse(url).path)).exists():
        return None
    vcs = found.get("vcs_info")
    return f"{vcs['vcs']}+{url}@{vcs['commit_id']}" if vcs else url
