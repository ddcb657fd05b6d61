r"""PGSR, its own training script, unedited and gated.

    python examples/train_pgsr.py --repo path/to/PGSR -- \
        -s data/garden --eval

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("pgsr", "train.py"))
