r"""Run the training script of Mini-Splatting2, unedited and with a gate. It needs CUDA.

    python examples/train_mini_splatting2.py --repo path/to/mini-splatting2 -- \
        -s data/garden --eval --imp_metric outdoor

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
`--script` chooses between msv2/train.py and msv2_d/train.py; the default is msv2/train.py.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("mini_splatting2", "msv2/train.py", "msv2_d/train.py"))
