r"""fVDB Reality Capture, its own training script, unedited and gated; needs CUDA.

    python examples/train_fvdb.py --repo path/to/fvdb-reality-capture -- \
        --dataset-path data/garden

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("fvdb", "train.py"))
