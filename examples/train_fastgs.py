r"""FastGS, its own training script, unedited and gated.

    python examples/train_fastgs.py --repo path/to/FastGS -- \
        -s data/garden -i images_4 --eval --densification_interval 500

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("fastgs", "train.py"))
