r"""Run the training script of FastGS, unedited and with a gate.

    python examples/train_fastgs.py --repo path/to/FastGS -- \
        -s data/garden -i images_4 --eval --densification_interval 500

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("fastgs", "train.py"))
