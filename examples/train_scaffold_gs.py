r"""Run the training script of Scaffold-GS, unedited and with a gate.

    python examples/train_scaffold_gs.py --repo path/to/Scaffold-GS -- \
        -s data/garden --eval -m output/garden

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("scaffold_gs", "train.py"))
