r"""Run the training script of GaussianSpa, unedited and with a gate.

    python examples/train_gaussianspa.py --repo path/to/GaussianSpa -- \
        -s data/garden --eval --prune_ratio2 0.7 --imp_metric outdoor --iterations 40000

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
`--script` chooses among its three scripts; the default is train_imp_score.py.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("gaussianspa", "train_imp_score.py", "train_opacity.py", "train_op.py"))
