r"""DashGaussian, its own training script, unedited and gated.

    python examples/train_dash_gaussian.py --repo path/to/DashGaussian -- \
        -s data/garden --eval --disable_viewer

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("dash_gaussian", "train_dash.py"))
