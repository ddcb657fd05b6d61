"""Run the training command of the pip package gaussian-splatting, unedited and with a gate.

    python examples/train_gaussian_splatting.py -- -s data/garden -d output/garden -i 30000 --mode densify

Put options of the gate (see `skipgs-plug run --help`) before `--`, and options of the command after it.
"""

import sys

from _checkout import run_module

sys.exit(run_module("step_trainer", "gaussian_splatting.train"))
