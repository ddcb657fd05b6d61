r"""Run the training script of Taming 3DGS, unedited and with a gate.

    python examples/train_taming.py --repo path/to/taming-3dgs -- \
        -s data/garden -i images_4 --eval --budget 15 --mode multiplier --densification_interval 500

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("taming", "train.py"))
