r"""Run the training script of PGSR, unedited and with a gate. It needs CUDA.

    python examples/train_pgsr.py --repo path/to/PGSR -- \
        -s data/garden --eval

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("pgsr", "train.py"))
