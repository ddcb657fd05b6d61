r"""Run the training script of AbsGS, unedited and with a gate.

    python examples/train_absgs.py --repo path/to/AbsGS -- \
        -s data/garden --eval

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("absgs", "train.py"))
