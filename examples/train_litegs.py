r"""LiteGS, its own training script, unedited and gated; needs CUDA.

    python examples/train_litegs.py --repo path/to/LiteGS -- \
        -s data/garden -i images_4 -m output

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("litegs", "example_train.py"))
