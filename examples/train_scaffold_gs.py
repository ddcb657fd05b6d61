r"""Scaffold-GS, its own training script, unedited and gated.

    python examples/train_scaffold_gs.py --repo path/to/Scaffold-GS -- \
        -s data/garden --eval -m output/garden

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("scaffold_gs", "train.py"))
