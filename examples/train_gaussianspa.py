r"""GaussianSpa, its own training script, unedited and gated.

    python examples/train_gaussianspa.py --repo path/to/GaussianSpa -- \
        -s data/garden --eval --prune_ratio2 0.7 --imp_metric outdoor --iterations 40000

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
`--script` chooses among its three scripts; the default is train_imp_score.py.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("gaussianspa", "train_imp_score.py", "train_opacity.py", "train_op.py"))
