r"""Run the training script of Inria's 3D Gaussian Splatting (classic or current), unedited and with a gate.

    python examples/train_inria.py --repo path/to/gaussian-splatting -- \
        -s data/garden --eval --disable_viewer

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("inria", "train.py"))
