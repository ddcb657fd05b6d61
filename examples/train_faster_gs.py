r"""Run the training script of Faster-GS in NeRFICG, unedited and with a gate. It needs CUDA.

    python examples/train_faster_gs.py --repo path/to/nerficg -- \
        -c configs/garden.yaml

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("faster_gs", "scripts/train.py"))
