r"""Run the training script of Deformable 3D Gaussians, unedited and with a gate. It needs CUDA.

    python examples/train_deformable.py --repo path/to/Deformable-3D-Gaussians -- \
        -s data/hook --is_blender

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("deformable", "train.py"))
