r"""Faster-GS in NeRFICG, its own training script, unedited and gated; needs CUDA.

    python examples/train_faster_gs.py --repo path/to/nerficg -- \
        -c configs/garden.yaml

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("faster_gs", "scripts/train.py"))
