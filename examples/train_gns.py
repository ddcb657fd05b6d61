r"""Run the training script of GNS, unedited and with a gate.

    python examples/train_gns.py --repo path/to/GNS -- \
        -s data/garden --eval

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
`--script` chooses between train.py and train-fast.py; the default is train.py.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("gns", "train.py", "train-fast.py"))
