r"""Run the training script of fVDB Reality Capture, unedited and with a gate. It needs CUDA.

    python examples/train_fvdb.py --repo path/to/fvdb-reality-capture -- \
        --dataset-path data/garden

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("fvdb", "train.py"))
