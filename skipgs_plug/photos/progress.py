"""How far pycolmap has got with a database, while one of its calls is under way."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

# Another process has to look: pycolmap brings its own SQLite, and when a second copy in one process closes a file, the
# locks of the first are gone (its calls then end in bus errors). It ends with its reader, when it cannot print.
WATCH = """
import sqlite3, sys, time
while True:
    try:
        connection = sqlite3.connect(sys.argv[1], uri=True, timeout=1)
        try:
            print(*connection.execute(f"select count(*) from {sys.argv[2]}").fetchone(), flush=True)
        finally:
            connection.close()
    except sqlite3.Error:  # not there yet: the next look will tell
        print(0, flush=True)
    time.sleep(0.3)
"""


@contextlib.contextmanager
def counted(database: Path, table: str, progress: Callable[[int], None]) -> Iterator[None]:
    """Report the rows that are added to a table inside the block."""
    command = [sys.executable, "-I", "-c", WATCH, f"{database.resolve().as_uri()}?mode=ro", table]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:

        def report() -> None:
            reported = 0
            assert process.stdout is not None
            for line in process.stdout:
                rows = max(int(line), reported)
                progress(rows - reported)
                reported = rows

        reader = threading.Thread(target=report, daemon=True)
        reader.start()
        try:
            yield
        finally:
            process.terminate()
            reader.join()
