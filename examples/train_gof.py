r"""Run the training script of Gaussian Opacity Fields, unedited and with a gate. It needs CUDA.

    python examples/train_gof.py --repo path/to/gaussian-opacity-fields -- \
        -s data/garden --eval

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("gof", "train.py"))
