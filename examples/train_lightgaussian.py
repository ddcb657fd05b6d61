r"""Run the training script of LightGaussian, unedited and with a gate.

    python examples/train_lightgaussian.py --repo path/to/LightGaussian -- \
        -s data/garden --eval --start_checkpoint chkpnt30000.pth --iterations 35000

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
`--script` chooses among its three scripts; the default is prune_finetune.py.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("lightgaussian", "prune_finetune.py", "train_densify_prune.py", "distill_train.py"))
