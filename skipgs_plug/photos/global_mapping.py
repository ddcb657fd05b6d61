"""All photographs placed at once (global structure from motion, GLOMAP), in a process of its own.

pycolmap handles no signals during global mapping, and ends the process when it finds a defect. Run as a module, this
file is the program of that process. It prints a line when one of its `STAGES` is done.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from skipgs_plug.trainer.loaders.native import import_pycolmap

STAGES = 6  # steps of the progress bar: focal lengths, positions, up to three adjustments, points
# Longest tracks of each photograph that place it. All tracks take longer for the same accuracy, see
# benchmarks/notes/PHOTOS.md; points of the other tracks are added afterwards.
TRACKS = 500
LEAST_POINTS = 30  # points that a placed photograph shows, at least: COLMAP's bound for incremental mapping
SEED = 0  # of COLMAP's random numbers
GLANCE = 0.5  # seconds between two looks at COLMAP's progress


def map_globally(database: Path, photos: Path, output: Path, progress: Callable[[int], None]) -> list[Any]:
    """Return the models, largest first; an empty list if the process failed.

    Args:
        output: folder to make, for the models and a copy of the database, whose focal lengths are corrected.
        progress: called with the number of stages that were finished since the last call, twice a second.
    """
    output.mkdir()
    copy = shutil.copyfile(database, output / "database.db")
    command = [sys.executable, "-m", __name__, str(copy), str(photos), str(output)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        finished: list[str] = []

        def read() -> None:
            assert process.stdout is not None
            for line in process.stdout:
                finished.append(line)

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        try:
            told = 0
            while reader.is_alive():
                reader.join(GLANCE)
                known = min(len(finished), STAGES)  # several models go through some stages each
                progress(known - told)
                told = known
        except BaseException:
            process.kill()
            raise
    if process.returncode:
        return []
    pycolmap = import_pycolmap()
    models = [pycolmap.Reconstruction(path) for path in sorted(output.iterdir()) if path.is_dir()]
    for model in models:
        leave_out_unsupported(model)
    return sorted((model for model in models if model.num_reg_images()), key=lambda model: -model.num_reg_images())


def leave_out_unsupported(model: Any) -> None:
    """Take the pose from photographs that hardly a point confirms: filters left them where they happened to be."""
    for image in list(model.images.values()):
        if image.has_pose and image.num_points3D < LEAST_POINTS:
            model.deregister_frame(image.frame_id)


def main(database: Path, photos: Path, output: Path) -> None:
    """Map, report progress, and write the models to numbered folders."""

    def done() -> None:
        print("done", flush=True)

    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    calibration = pycolmap.ViewGraphCalibrationOptions()
    calibration.random_seed = SEED
    pycolmap.calibrate_view_graph(database, calibration)
    done()
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = SEED
    options.image_path = photos  # points get colours
    options.mapper.track_required_tracks_per_view = TRACKS
    models = pycolmap.ReconstructionManager()
    opened = pycolmap.Database.open(database)
    pipeline = pycolmap.GlobalPipeline(options, opened, models)
    pipeline.add_callback(pycolmap.GlobalPipelineCallback.MODEL_UPDATE_CALLBACK, done)
    pipeline.run()
    opened.close()
    for number in range(models.size()):
        folder = output / str(number)
        folder.mkdir()
        models.get(number).write(folder)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
