r"""Mini-Splatting, its own training script, unedited and gated.

    python examples/train_mini_splatting.py --repo path/to/mini-splatting -- \
        -s data/garden --eval --imp_metric outdoor

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
`--script` chooses between ms/train.py and ms_d/train.py; the default is the first.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("mini_splatting", "ms/train.py", "ms_d/train.py"))
