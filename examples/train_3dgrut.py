r"""3DGRUT, its own training script, unedited and gated; needs CUDA.

    python examples/train_3dgrut.py --repo path/to/3dgrut -- \
        --config-name apps/colmap_3dgut.yaml path=data/garden out_dir=runs

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("3dgrut", "train.py"))
