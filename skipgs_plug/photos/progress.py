"""Count the finished rows of a pycolmap call while it runs."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

# Program of a separate process that counts the rows. pycolmap contains its own copy of SQLite: when a second copy in
# the same process closes the file, the locks of the first are lost, and its calls end in bus errors. The program ends
# with its reader, because it can no longer print.
WATCH = """
import sqlite3, sys, time
while True:
    try:
        connection = sqlite3.connect(sys.argv[1], uri=True, timeout=1)
        try:
            print(*connection.execute(f"select count(*) from {sys.argv[2]}").fetchone(), flush=True)
        finally:
            connection.close()
    except sqlite3.Error:  # the database or the table does not exist yet
        print(0, flush=True)
    time.sleep(0.3)
"""


@contextlib.contextmanager
def counted(database: Path, table: str, progress: Callable[[int], None]) -> Iterator[None]:
    """Call `progress` with the number of rows that were added to a table of the database inside the block."""
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
