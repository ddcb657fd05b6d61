"""Place all photographs at once (global structure from motion, GLOMAP), in a separate process.

pycolmap does not handle signals during global mapping, and it ends the process when it finds a defect. The separate
process runs this file as a module. It prints a line after each stage.
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

# Number of steps of the progress bar: focal lengths, positions, up to three adjustments, points.
STAGES = 6
# Number of tracks per photograph that place it; the longest are taken. All tracks would take longer for the same
# accuracy, see benchmarks/notes/PHOTOS.md. The points of the other tracks are added afterwards.
TRACKS = 500
LEAST_POINTS = 30  # least number of points in a placed photograph; COLMAP's bound for incremental mapping
SEED = 0  # seed of COLMAP's random numbers
GLANCE = 0.5  # seconds between two updates of the progress bar


def map_globally(database: Path, photos: Path, output: Path, progress: Callable[[int], None]) -> list[Any]:
    """Place photographs in a separate process; return the models, largest first, or an empty list if it failed.

    Args:
        database: COLMAP's database with features and verified matches. It is not changed.
        photos: Folder of the photographs.
        output: Folder to create. It receives the models and a copy of the database with corrected focal lengths.
        progress: Called every `GLANCE` seconds with the number of stages that finished since the last call.
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
                known = min(len(finished), STAGES)  # each of several models repeats some stages
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
    """Remove the pose of photographs with fewer than LEAST_POINTS points: their position is arbitrary."""
    for image in list(model.images.values()):
        if image.has_pose and image.num_points3D < LEAST_POINTS:
            model.deregister_frame(image.frame_id)


def main(database: Path, photos: Path, output: Path) -> None:
    """Map the photographs, print progress, and write the models to numbered folders in `output`."""

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
    options.image_path = photos  # gives the points their colours
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
