r"""Improved-GS, its own training script, unedited and gated.

    python examples/train_improved_gs.py --repo path/to/Improved-GS -- \
        -s data/garden --eval --budget 2000000

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("improved_gs", "train.py"))
