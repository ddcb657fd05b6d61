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


def test_the_order_that_crashes_is_refused_at_import() -> None:
    code = "import pycolmap\nimport skipgs_plug.trainer\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if sys.platform == "linux":
        assert "ImportError: pycolmap was imported before Pillow" in done.stderr and done.returncode == 1
    else:
        assert done.returncode == 0, done.stderr
