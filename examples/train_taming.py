r"""Taming 3DGS, its own training script, unedited and gated.

    python examples/train_taming.py --repo path/to/taming-3dgs -- \
        -s data/garden -i images_4 --eval --budget 15 --mode multiplier --densification_interval 500

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("taming", "train.py"))
