r"""EDGS, its own training script, unedited and gated; needs CUDA.

    python examples/train_edgs.py --repo path/to/EDGS -- \
        train.gs_epochs=30000 gs.dataset.source_path=data/garden gs.dataset.model_path=output

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("edgs", "train.py"))
