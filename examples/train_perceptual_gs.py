r"""Perceptual-GS, its own training script, unedited and gated.

    python examples/train_perceptual_gs.py --repo path/to/Perceptual-GS -- \
        -s data/garden --eval

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("perceptual_gs", "train.py"))
