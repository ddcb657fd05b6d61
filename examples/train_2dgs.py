r"""2D Gaussian Splatting, its own training script, unedited and gated.

    python examples/train_2dgs.py --repo path/to/2d-gaussian-splatting -- \
        -s data/garden --eval

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("2dgs", "train.py"))
