r"""Run the training script of Mini-Splatting, unedited and with a gate.

    python examples/train_mini_splatting.py --repo path/to/mini-splatting -- \
        -s data/garden --eval --imp_metric outdoor

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
`--script` chooses between ms/train.py and ms_d/train.py; the default is ms/train.py.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("mini_splatting", "ms/train.py", "ms_d/train.py"))
