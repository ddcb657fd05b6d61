r"""Gaussian Opacity Fields, its own training script, unedited and gated.

    python examples/train_gof.py --repo path/to/gaussian-opacity-fields -- \
        -s data/garden --eval

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("gof", "train.py"))
