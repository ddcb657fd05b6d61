r"""Run the training script of EDGS, unedited and with a gate. It needs CUDA.

    python examples/train_edgs.py --repo path/to/EDGS -- \
        train.gs_epochs=30000 gs.dataset.source_path=data/garden gs.dataset.model_path=output

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("edgs", "train.py"))
