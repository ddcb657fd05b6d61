r"""Run the training script of 2D Gaussian Splatting, unedited and with a gate. It needs CUDA.

    python examples/train_2dgs.py --repo path/to/2d-gaussian-splatting -- \
        -s data/garden --eval

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("2dgs", "train.py"))
