r"""Run the training script of Speedy-Splat, unedited and with a gate.

    python examples/train_speedy_splat.py --repo path/to/speedy-splat -- \
        -s data/garden --eval

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("speedy_splat", "train.py"))
