r"""3DGS-MCMC, its own training script, unedited and gated.

    python examples/train_mcmc.py --repo path/to/3dgs-mcmc -- \
        -s data/garden --cap_max 1000000

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("mcmc", "train.py"))
