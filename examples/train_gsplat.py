r"""gsplat's simple_trainer.py (PyPI 1.5.3 or HEAD), its own training script, unedited and gated.

    python examples/train_gsplat.py --repo path/to/gsplat -- \
        default --data_dir data/garden --data_factor 4 --result_dir results/garden --disable_viewer

Options of the gate (`skipgs-plug run --help`) stand before `--`, options of the script after it.
`default` or `mcmc` is the script's first argument.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("gsplat", "examples/simple_trainer.py"))
