r"""Run the training script of Mip-Splatting, unedited and with a gate.

    python examples/train_mip_splatting.py --repo path/to/mip-splatting -- \
        -s data/garden --eval

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("mip_splatting", "train.py"))
