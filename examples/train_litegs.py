r"""Run the training script of LiteGS, unedited and with a gate. It needs CUDA.

    python examples/train_litegs.py --repo path/to/LiteGS -- \
        -s data/garden -i images_4 -m output

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("litegs", "example_train.py"))
