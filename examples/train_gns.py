r"""GNS, its own training script, unedited and gated.

    python examples/train_gns.py --repo path/to/GNS -- \
        -s data/garden --eval

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
`--script` chooses between train.py and train-fast.py; the default is the first.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("gns", "train.py", "train-fast.py"))
