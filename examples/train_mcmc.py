r"""Run the training script of 3DGS-MCMC, unedited and with a gate.

    python examples/train_mcmc.py --repo path/to/3dgs-mcmc -- \
        -s data/garden --cap_max 1000000

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("mcmc", "train.py"))
