r"""Run the training script of DashGaussian, unedited and with a gate.

    python examples/train_dash_gaussian.py --repo path/to/DashGaussian -- \
        -s data/garden --eval --disable_viewer

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("dash_gaussian", "train_dash.py"))
