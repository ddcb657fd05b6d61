r"""Deformable 3D Gaussians, its own training script, unedited and gated.

    python examples/train_deformable.py --repo path/to/Deformable-3D-Gaussians -- \
        -s data/hook --is_blender

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("deformable", "train.py"))
