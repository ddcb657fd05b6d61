r"""Mini-Splatting2, its own training script, unedited and gated.

    python examples/train_mini_splatting2.py --repo path/to/mini-splatting2 -- \
        -s data/garden --eval --imp_metric outdoor

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
`--script` chooses between msv2/train.py and msv2_d/train.py; the default is the first.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("mini_splatting2", "msv2/train.py", "msv2_d/train.py"))
