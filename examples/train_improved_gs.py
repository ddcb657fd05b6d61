r"""Run the training script of Improved-GS, unedited and with a gate.

    python examples/train_improved_gs.py --repo path/to/Improved-GS -- \
        -s data/garden --eval --budget 2000000

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("improved_gs", "train.py"))
