r"""Inria's 3D Gaussian Splatting (classic or current), its own training script, unedited and gated.

    python examples/train_inria.py --repo path/to/gaussian-splatting -- \
        -s data/garden --eval --disable_viewer

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("inria", "train.py"))
