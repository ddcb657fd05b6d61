r"""Run the training script of Perceptual-GS, unedited and with a gate.

    python examples/train_perceptual_gs.py --repo path/to/Perceptual-GS -- \
        -s data/garden --eval

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("perceptual_gs", "train.py"))
