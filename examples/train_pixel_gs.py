r"""Run the training script of Pixel-GS, unedited and with a gate.

    python examples/train_pixel_gs.py --repo path/to/Pixel-GS -- \
        -s data/garden --eval

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("pixel_gs", "train.py"))
