"""pycolmap and Pillow in one process: a PNG can be written after both are loaded."""

from __future__ import annotations

import subprocess
import sys


def test_png_after_pycolmap(tmp_path) -> None:
    code = (
        "from skipgs_plug.trainer.loaders.native import import_pycolmap\n"
        "import_pycolmap()\n"
        "from PIL import Image\n"
        f"Image.new('RGB', (64, 64), 'red').save({str(tmp_path / 'x.png')!r})\n"
        f"Image.open({str(tmp_path / 'x.png')!r}).load()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
