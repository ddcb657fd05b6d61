r"""Run the training script of 3DGRUT, unedited and with a gate. It needs CUDA.

    python examples/train_3dgrut.py --repo path/to/3dgrut -- \
        --config-name apps/colmap_3dgut.yaml path=data/garden out_dir=runs

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("3dgrut", "train.py"))
