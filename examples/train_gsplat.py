r"""Run gsplat's simple_trainer.py (PyPI 1.5.3 or HEAD), unedited and with a gate.

    python examples/train_gsplat.py --repo path/to/gsplat -- \
        default --data_dir data/garden --data_factor 4 --result_dir results/garden --disable_viewer

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the script after it.
`default` or `mcmc` is the script's first argument.
"""

import sys

from _checkout import run_in_checkout

sys.exit(run_in_checkout("gsplat", "examples/simple_trainer.py"))
